"""
Does planning predict what happens? Learn from planned places in simulation, and compare.

``python test/plan_check.py --seeds 301 302`` plans a pair in rooms out of seeds, learns from it,
from the median random pair and from the layout of Livatino and Madsen. For each it prints what
was predicted, what the learned map claims and what is true: landmarks, their errors, and the
localization error at random places with bearings of known noise to all landmarks that a turning
camera sees there. Millimetres, root mean squares.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
import sys

import cv2
import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import compose
from landmark_nav.learning.pipeline import (
    learn_from_panoramas,
    LearningConfig,
    LearningResult,
    panorama_from_sweep,
    PanoramaStages,
)
from landmark_nav.localization.triangulation import triangulate
from landmark_nav.localization.triplet_visibility import (
    axis_position,
    observable,
    patch_corners,
    whole_in_view,
)
from landmark_nav.planning.config import PlanConfig
from landmark_nav.planning.planner import Forecast, forecast, plan_positions
from landmark_nav.planning.room_grid import free_floor
from landmark_nav.simulation.room_generator import generate_scene
from landmark_nav.simulation.scene import Scene
from landmark_nav.simulation.world import DEFAULT_CAMERA, DEFAULT_MOUNT, RobotWorld
from landmark_nav.types import CameraFrame, FloatArray, Landmark, PoseEstimate, Refusal, Sweep

FRAMES = 72
PLACES = 200


def check_room(seed: int, config: PlanConfig) -> Iterator[dict[str, float | str]]:
    """Plan, learn and localize in one room."""
    # The planner knows walls, not furniture: without it the comparison is about the prediction.
    scene = replace(generate_scene(seed), boxes=())
    rng = np.random.default_rng(seed)
    plan = plan_positions(scene.room, DEFAULT_MOUNT, 2, config, rng)
    floor = free_floor(scene.room, config.clearance_m, 0.1, 10000)
    cells = rng.permutation(floor)[:PLACES]
    world = RobotWorld(scene, plan.best.poses_map_base[0], seed)
    layouts = {'planned': plan.best, 'random': plan.random[len(plan.random) // 2]}
    if plan.left_right is not None:
        layouts['left-right'] = plan.left_right
    for name, places in layouts.items():
        poses = places.poses_map_base
        (expected,) = forecast([poses], cells, scene.room, DEFAULT_MOUNT, config)
        row: dict[str, float | str] = {'seed': seed, 'places': name}
        row['baseline_m'] = float(np.linalg.norm(np.diff(poses[:, :2], axis=0)))
        try:
            result = learn(world, scene, poses)
        except LandmarkNavError as error:
            print(f'{seed} {name}: {error}', file=sys.stderr)
            continue
        yield {**row, **compare(result, scene, poses, expected, cells, rng)}


def learn(world: RobotWorld, scene: Scene, poses: FloatArray) -> LearningResult:
    """Sweep at each pose and learn."""
    panoramas = []
    for pose in poses:
        frames = []
        for k in range(FRAMES):
            world.place(pose, -np.pi + 2.0 * np.pi * k / FRAMES)
            world.advance(1.0 / 60.0)
            frame = world.camera_frame()
            jpeg = cv2.imencode('.jpg', frame.image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
            frames.append(
                CameraFrame(
                    frame.stamp_ns,
                    np.asarray(cv2.imdecode(jpeg, 1), np.uint8),
                    frame.camera,
                    frame.pan_rad,
                )
            )
        sweep = Sweep(frames[0].stamp_ns, tuple(frames))
        panoramas.append(panorama_from_sweep(sweep, scene.room, world.mount, PanoramaStages()))
    return learn_from_panoramas(panoramas, scene.room, LearningConfig())


def compare(
    result: LearningResult,
    scene: Scene,
    poses: FloatArray,
    expected: Forecast,
    cells: FloatArray,
    rng: np.random.Generator,
) -> dict[str, float | str]:
    """Set what was learned beside what was predicted; millimetres, root mean squares."""
    learned = result.map
    truth = true_positions(result, scene, poses)
    error = np.linalg.norm(learned.positions[:, :2] - truth, axis=1)
    claimed = np.sqrt(np.mean(np.trace(learned.covariances[:, :2, :2], axis1=1, axis2=2)))
    fixes = np.array([localize(cell, result, truth, rng) for cell in cells])
    both = np.isfinite(expected.sigma_m) & np.isfinite(fixes[:, 0])
    return {
        'n_pred': expected.landmarks,
        'n': len(error),
        'lm_pred': 1e3 * expected.landmark_sigma_m,
        'lm_map': 1e3 * float(claimed),
        'lm_err': 1e3 * rms(error[error < 0.05]),
        'wrong': float(np.sum(error >= 0.05)),
        'loc_pred': 1e3 * rms(expected.sigma_m[both]),
        'loc_map': 1e3 * rms(fixes[both, 1]),
        'loc_err': 1e3 * rms(fixes[both, 0]),
        'median_pred': 1e3 * float(np.median(expected.sigma_m[both])),
        'median_err': 1e3 * float(np.median(fixes[both, 0])),
        'no_fix': float(np.mean(~np.isfinite(fixes[:, 0]))),
    }


def true_positions(result: LearningResult, scene: Scene, poses: FloatArray) -> FloatArray:
    """Where on the walls the patches of the landmarks really are, (n, 2)."""
    truth = np.zeros((len(result.map.landmarks), 2))
    for pose, panorama, candidates, outcomes in zip(
        poses, result.panoramas, result.candidates, result.outcomes, strict=True
    ):
        axis = axis_position(pose, DEFAULT_MOUNT)[:2]
        for candidate, outcome in zip(candidates, outcomes, strict=True):
            if isinstance(outcome, Landmark):
                azimuth = float(panorama.cylinder.azimuth_rad(candidate.column)) + pose[2]
                reach = float(scene.room.raycast(axis, azimuth)[0])
                place = axis + reach * np.array([np.cos(azimuth), np.sin(azimuth)])
                truth[result.map.indices(np.array([outcome.id]))[0]] = place
    return truth


def localize(
    cell: FloatArray, result: LearningResult, truth: FloatArray, rng: np.random.Generator
) -> tuple[float, float]:
    """Error of a fix at a place, and the one it claims; inf where there is none."""
    config = PlanConfig()
    base = np.array([*cell, rng.uniform(-np.pi, np.pi)])
    mount: PanTiltMount = DEFAULT_MOUNT
    axis = compose(base, [*mount.axis_xyz[:2], 0.0])
    index = np.flatnonzero(observable(axis_position(base, mount), result.map, config.triplet))
    delta = truth[index] - axis[:2]
    bearing = np.arctan2(delta[:, 1], delta[:, 0]) - axis[2]
    whole = whole_in_view(
        patch_corners(result.map)[index],
        base,
        DEFAULT_CAMERA,
        mount,
        bearing,
        0.0,
        config.triplet.border_px,
    )
    index, bearing = index[whole], bearing[whole]
    sigma = config.triplet.bearing_sigma_rad
    rows = np.stack([2 * index, 2 * index + 1], -1).reshape(-1)
    fix = triangulate(
        result.map.positions[index, :2],
        bearing + rng.normal(0.0, sigma, len(bearing)),
        np.full(len(bearing), sigma**2),
        result.map.joint_covariance_xy[np.ix_(rows, rows)],
        PoseEstimate(0, axis, np.diag([0.3, 0.3, 0.1]) ** 2),
    )
    if isinstance(fix, Refusal):
        return np.inf, np.inf
    error = float(np.linalg.norm(fix.pose[:2] - axis[:2]))
    return error, float(np.sqrt(np.trace(fix.covariance[:2, :2])))


def rms(values: FloatArray) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float('nan')


def main() -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, nargs='+', required=True)
    parser.add_argument('--clearance', type=float, default=PlanConfig().clearance_m, metavar='M')
    args = parser.parse_args()
    config = PlanConfig(clearance_m=args.clearance)
    cv2.setNumThreads(1)
    header = False
    for seed in args.seeds:
        for row in check_room(seed, config):
            if not header:
                print('  '.join(f'{name:>11}' for name in row))
                header = True
            cells = (v if isinstance(v, str) else f'{v:.4g}' for v in row.values())
            print('  '.join(f'{cell:>11}' for cell in cells), flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
