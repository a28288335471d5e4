"""
How well single bearings are measured, and whether their variances are consistent.

python test/detection_check.py --map MAP --robot robot.yaml BAG [--noise GREY] [--prior M RAD]
    [--appearance patch virtual_view] [--start start.json] [--seeds N …]

One row for each kind of expected appearance; `{seed}` in paths stands for the seeds, over which
the last rows are means. With a start the drive is also localized, as `evaluate` does it.

Every image of a drive is searched for the landmarks in view from its true pose, made wrong by
the prior's errors. What remains of the map's error (a shift of each landmark) and of the pan (one
angle an image) is fitted and taken out, so that the rest is the error of detection alone (of
`with_map_px` it is not). A mean square of 1 is consistent; the robust one stands on the median and
leaves wrong matches out.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields, replace
from itertools import product
import json
from pathlib import Path
import sys
import time

import cv2
import numpy as np
from scipy.sparse import coo_matrix, vstack
from scipy.sparse.linalg import spsolve

from landmark_nav.evaluation.metrics import error_summary
from landmark_nav.evaluation.replay import replay
from landmark_nav.evaluation.run_report import run_errors
from landmark_nav.evaluation.tracks import PoseTrack
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.detection import detect_landmarks, DetectionConfig
from landmark_nav.localization.detection.appearance import APPEARANCES
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.localization.triangulation.model import (
    axis_from_base,
    bearing_gradients,
    bearing_residuals,
)
from landmark_nav.localization.triplet import TripletConfig, visible_landmarks
from landmark_nav.storage.bags import Bag, sensor_events
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_calibration
from landmark_nav.storage.setup_files import load_robot
from landmark_nav.types import CameraFrame, FloatArray, PoseEstimate

# Of the normal distribution: the median of a square.
_MEDIAN_SQUARE = 0.4549
_FAR = 5.0


@dataclass(frozen=True)
class Summary:
    """What came of a drive."""

    looked: int
    found: float
    mean_square: float
    robust_square: float
    rms_px: float
    median_px: float
    with_map_px: float
    wrong: float
    ms_per_patch: float
    fused_mm: float = np.nan
    fused_deg: float = np.nan
    fix_mm: float = np.nan
    update_ms: float = np.nan


def check(
    bag_path: str, map_path: str, robot_path: str, noise: float, prior_sigmas: tuple[float, float],
    config: DetectionConfig, every: int = 1, seed: int = 0,
) -> Summary:  # fmt: skip
    """Search every image of a drive."""
    rng = np.random.default_rng(seed)
    mount, landmarks = load_robot(robot_path), load_map(map_path)
    frames: list[CameraFrame] = []
    truth: list[tuple[int, FloatArray]] = []
    for event in sensor_events(Bag(bag_path), mount):
        if isinstance(event, CameraFrame):
            frames.append(event)
        elif isinstance(event, PoseEstimate):
            truth.append((event.stamp_ns, event.pose))
    poses = PoseTrack.of(truth).at([frame.stamp_ns for frame in frames])
    sigma = np.array([prior_sigmas[0], prior_sigmas[0], prior_sigmas[1]])
    rows, looked, seconds, focal = [], 0, 0.0, frames[0].camera.fx
    for k, (frame, pose) in enumerate(zip(frames[::every], poses[::every], strict=True)):
        if np.isnan(pose).any():
            continue
        prior = PoseEstimate(frame.stamp_ns, pose + sigma * rng.normal(size=3), np.diag(sigma**2))
        index = visible_landmarks(
            prior, landmarks, frame.camera, mount, frame.pan_rad, frame.tilt_rad, TripletConfig()
        )
        if noise:
            image = frame.image + rng.normal(0.0, noise, frame.image.shape)
            frame = replace(frame, image=np.clip(np.rint(image), 0, 255).astype(np.uint8))
        begin = time.process_time()
        found = detect_landmarks(frame, prior, landmarks, mount, config, index).detections
        seconds += time.process_time() - begin
        looked += len(index)
        where = landmarks.indices(found.ids)
        axis = axis_from_base(PoseEstimate(0, pose, np.zeros((3, 3))), mount).pose
        places = landmarks.positions[where, :2]
        residual = bearing_residuals(axis, places, found.bearing_rad)
        gradient = bearing_gradients(axis, places)
        rows += [
            (k, j, r, s, *g)
            for j, r, s, g in zip(where, residual, found.variance_rad2, gradient, strict=True)
        ]
    table = np.array(rows)
    left = _without_map_and_pan(table, landmarks.covariances[:, :2, :2])
    square = left**2 / table[:, 3]
    px = np.abs(left) * focal
    return Summary(
        looked,
        len(table) / looked,
        float(np.mean(square[square < _FAR**2])),
        float(np.median(square)) / _MEDIAN_SQUARE,
        float(np.sqrt(np.mean(px[square < _FAR**2] ** 2))),
        float(np.median(px)),
        focal * float(np.median(np.abs(wrap_rad(table[:, 2])))),
        float(np.mean(square > _FAR**2)),
        1e3 * seconds / looked,
    )


def drive(
    bag_path: str, map_path: str, robot_path: str, config: DetectionConfig, start: str
) -> dict[str, float]:
    """Errors of a whole drive, and the median time of an update."""
    calibration, landmarks = load_calibration(robot_path), load_map(map_path)
    localization = LocalizationConfig(detection=config)
    pose = np.array(json.loads(Path(start).read_text(encoding='utf-8'))['pose'])
    covariance = np.diag([0.05, 0.05, 0.035]) ** 2
    events = sensor_events(Bag(bag_path), calibration.mount)
    run = replay(events, landmarks, calibration, localization, pose, covariance)
    errors = run_errors(run)
    fused, fixes = error_summary(errors.fused), error_summary(errors.triangulation)
    return {
        'fused_mm': 1e3 * (fused['position_rmse_m'] or np.nan),
        'fused_deg': fused['heading_rmse_deg'] or np.nan,
        'fix_mm': 1e3 * (fixes['position_median_m'] or np.nan),
        'update_ms': 1e3 * float(np.median(run.update_seconds)),
    }


def _without_map_and_pan(table: FloatArray, map_covariance: FloatArray) -> FloatArray:
    """Residuals without what a shift of each landmark and a turn of each image explain."""
    frame, landmark = table[:, 0].astype(int), table[:, 1].astype(int)
    residual, sigma, gradient = wrap_rad(table[:, 2]), np.sqrt(table[:, 3]), table[:, 4:6]
    frames, landmarks = frame.max() + 1, len(map_covariance)
    n, row = len(table), np.arange(len(table))
    design = coo_matrix(
        (
            np.concatenate([-gradient[:, 0], -gradient[:, 1], np.ones(n)]),
            (np.tile(row, 3), np.r_[2 * landmark, 2 * landmark + 1, 2 * landmarks + frame]),
        ),
        shape=(n, 2 * landmarks + frames),
    ).tocsr()
    # The prior: 5 cm for a landmark's place, 1 mrad for a pan.
    spread = np.r_[np.full(2 * landmarks, 0.05), np.full(frames, 1e-3)]
    ridge = coo_matrix((1.0 / spread, (np.arange(len(spread)),) * 2)).tocsr()
    weight = np.ones(n)
    for _ in range(6):
        w = weight / sigma
        scaled = vstack([design.multiply(w[:, None]), ridge]).tocsr()
        solution = spsolve(
            (scaled.T @ scaled).tocsc(), scaled.T @ np.r_[w * residual, np.zeros(len(spread))]
        )
        left = residual - design @ solution
        weight = 1.0 / np.sqrt(1.0 + (left / sigma / 3.0) ** 2)
    # What was fitted took its share of the squares: leverage, one parameter for many rows.
    counts_l = np.bincount(landmark, minlength=landmarks)[landmark]
    counts_f = np.bincount(frame, minlength=frames)[frame]
    leverage = np.minimum(2.0 / counts_l + 1.0 / counts_f, 0.9)
    keep = leverage < 0.5
    return np.asarray(np.where(keep, left / np.sqrt(1.0 - leverage), 0.0))


def main() -> int:
    """Print one row for each appearance, noise and seed."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('bag')
    parser.add_argument('--map', required=True)
    parser.add_argument('--robot', required=True)
    parser.add_argument('--noise', type=float, nargs='+', default=[0.0], help='grey levels added')
    parser.add_argument('--every', type=int, default=1, help='look at every n-th image')
    parser.add_argument('--prior', type=float, nargs=2, default=(0.02, 0.007))
    parser.add_argument(
        '--appearance', nargs='+', choices=APPEARANCES, default=[DetectionConfig().appearance]
    )
    parser.add_argument('--start', help='start.json: where the drive begins')
    parser.add_argument('--seeds', nargs='+', default=[''])
    args = parser.parse_args()
    cv2.setNumThreads(1)
    names = [f.name for f in fields(Summary)]
    print(f'{"":>28}' + ''.join(f'{name:>14}' for name in names))
    rows: dict[str, list[Summary]] = {}
    for seed, noise, appearance in product(args.seeds, args.noise, args.appearance):
        paths = [path.format(seed=seed) for path in (args.bag, args.map, args.robot)]
        config = DetectionConfig(appearance=appearance)
        summary = check(*paths, noise, tuple(args.prior), config, args.every)
        if args.start:
            summary = replace(summary, **drive(*paths, config, args.start.format(seed=seed)))
        name = f'{appearance} {noise:g}'
        rows.setdefault(name, []).append(summary)
        _print(f'{seed} {name}', [summary])
    if len(args.seeds) > 1:
        for name, several in rows.items():
            _print(f'all {name}', several)
    return 0


def _print(name: str, rows: list[Summary]) -> None:
    means = [np.mean([getattr(row, f.name) for row in rows]) for f in fields(Summary)]
    print(f'{name:>28}' + ''.join(f'{mean:14.4g}' for mean in means), flush=True)


if __name__ == '__main__':
    sys.exit(main())
