"""
How well single bearings are measured, and whether their variances are honest.

python test/detection_check.py --map MAP --robot robot.yaml BAG [--noise GREY] [--prior M RAD]

Every picture of a drive is searched for the landmarks in view from its true pose, made wrong by
the prior's errors. What remains of the map's error (a shift of each landmark) and of the pan (one
angle a picture) is fitted and taken out, so that the rest is the error of detection alone. A mean
square of 1 is honest; the robust one stands on the median and leaves wrong matches out.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields, replace
import sys
import time

import cv2
import numpy as np
from scipy.sparse import coo_matrix, vstack
from scipy.sparse.linalg import spsolve

from landmark_nav.evaluation.tracks import PoseTrack
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.detection import detect_landmarks, DetectionConfig
from landmark_nav.localization.triangulation.model import (
    axis_from_base,
    bearing_gradients,
    bearing_residuals,
)
from landmark_nav.localization.triplet import TripletConfig, visible_landmarks
from landmark_nav.storage.bags import Bag, sensor_events
from landmark_nav.storage.maps import load_map
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
    wrong: float
    ms_per_patch: float


def check(
    bag_path: str, map_path: str, robot_path: str, noise: float, prior_sigmas: tuple[float, float],
    config: DetectionConfig, every: int = 1, seed: int = 0,
) -> Summary:  # fmt: skip
    """Search every picture of a drive."""
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
        float(np.mean(square > _FAR**2)),
        1e3 * seconds / looked,
    )


def _without_map_and_pan(table: FloatArray, map_covariance: FloatArray) -> FloatArray:
    """Residuals without what a shift of each landmark and a turn of each picture explain."""
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
    """Print one row."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('bag')
    parser.add_argument('--map', required=True)
    parser.add_argument('--robot', required=True)
    parser.add_argument('--noise', type=float, nargs='+', default=[0.0], help='grey levels added')
    parser.add_argument('--every', type=int, default=1, help='look at every n-th picture')
    parser.add_argument('--prior', type=float, nargs=2, default=(0.02, 0.007))
    args = parser.parse_args()
    cv2.setNumThreads(1)
    names = [f.name for f in fields(Summary)]
    print(f'{"noise":>14}' + ''.join(f'{name:>15}' for name in names))
    for noise in args.noise:
        row = check(
            args.bag, args.map, args.robot, noise, tuple(args.prior), DetectionConfig(), args.every
        )
        print(f'{noise:14.1f}' + ''.join(f'{getattr(row, name):15.4g}' for name in names))
    return 0


if __name__ == '__main__':
    sys.exit(main())
