"""
Where to look, compared: the active camera, a fixed one, and random triplets.

``python test/benchmarks cameras --seeds 901 902`` simulates rooms, learns each from two sweeps,
and drives the same way again and again, each time with another rule for the camera: the pan of
the simulated unit is commanded, in the loop, by what localization has found until then. One line
a rule: errors of the fused pose and of single fixes, availability, and the share of images with
a fix. Nothing was tuned on the seeds from 901 on.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from harness import learned_room, print_row, rooms_parser, summary
import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import bearings
from landmark_nav.localization.localizer import LocalizationConfig, LocalizationUpdate, Localizer
from landmark_nav.localization.triplet.planning_scene import CameraState
from landmark_nav.localization.triplet.selection import ActiveCamera
from landmark_nav.simulation.drive_path import PathFollower, plan_tour
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.simulation.world import DEFAULT_CAMERA, DEFAULT_MOUNT, RobotWorld
from landmark_nav.types import FloatArray, PoseEstimate, Triplet

STATE_RATE_HZ = 20
CAMERA_RATE_HZ = 5
START_SIGMA = (0.02, 0.02, 0.01)

# What a rule gets to know: the last update, the time and the robot; it returns a pan.
Rule = Callable[[LocalizationUpdate, float], float | None]


class Run(NamedTuple):
    """What came of a drive: errors (n, 3) and whether the state was lost, an image each."""

    fused: FloatArray
    fixes: FloatArray
    lost: FloatArray


def main():
    """Print the table."""
    parser = rooms_parser(__doc__)
    parser.add_argument('--seconds', type=float, default=30.0, help='of each drive (30)')
    arguments = parser.parse_args()
    runs: dict[str, list[Run]] = {}
    for seed in arguments.seeds:
        scene, learned = generate_scene(seed), learned_room(seed, arguments.maps)
        for name, run in compare(seed, scene, learned, arguments.seconds).items():
            runs.setdefault(name, []).append(run)
            print_row(_row(f'{seed} {name}', [run]), 13)
    for k, (name, several) in enumerate(runs.items()):
        print_row(_row(name, several), 13, k == 0)
    return 0


def compare(seed, scene, landmark_map, seconds):
    """Drive the same way with each rule."""
    rng = np.random.default_rng([seed, 77])
    start = landmark_map.panorama_poses[0].pose[:2]
    path = plan_tour(scene, start, 0.42 * seconds + 2.0, rng)
    world = RobotWorld(scene, np.zeros(3), seed)
    config = LocalizationConfig()
    config = replace(config, triplet=replace(config.triplet, pan_rate_rad_s=2.1))
    return {
        name: _drive(seed, scene, world.renderer, landmark_map, path, seconds, config, rule)
        for name, rule in (
            ('active', _Active(landmark_map, config)),
            ('fixed pan', lambda _update, _time: 0.0),
            ('random triplets', _Random(landmark_map, seed)),
        )
    }


class _Active:
    """Looks at the triplet that is best, chosen anew every half second."""

    def __init__(self, landmark_map, config):
        self._camera = ActiveCamera(landmark_map, DEFAULT_MOUNT, config.triplet)
        self._pan: float | None = None
        self._until_s = 0.0

    def __call__(self, update, time_s):
        self._camera.saw(update.observation.detections)
        if time_s >= self._until_s:
            now = CameraState(self._pan)
            chosen = self._camera.choose(update.fused, DEFAULT_CAMERA, now).chosen
            self._pan = chosen.pan_rad if isinstance(chosen, Triplet) else self._pan
            self._until_s = time_s + 0.5
        return self._pan


class _Random:
    """Looks at the middle of three landmarks that fit one view, drawn anew every two seconds."""

    def __init__(self, landmark_map, seed):
        self._positions = landmark_map.positions[:, :2]
        self._rng = np.random.default_rng(seed)
        self._target: FloatArray | None = None
        self._until_s = 0.0

    def __call__(self, update, time_s):
        pan = bearings(update.fused.pose, self._positions)
        if self._target is None or time_s >= self._until_s:
            first = int(self._rng.integers(len(pan)))
            near = np.flatnonzero(np.abs(wrap_rad(pan - pan[first])) < 0.35)
            chosen = self._rng.choice(near, min(3, len(near)), replace=False)
            self._target = self._positions[chosen].mean(axis=0)
            self._until_s = time_s + 2.0
        return float(bearings(update.fused.pose, self._target))


def _drive(seed, scene, renderer, landmark_map, path, seconds, config, rule):
    """Drive along the path and look where the rule says."""
    ahead = path[min(8, len(path) - 1)] - path[0]
    pose = np.array([*path[0], np.arctan2(ahead[1], ahead[0])])
    world = RobotWorld(scene, pose, seed, renderer=renderer)
    driver = PathFollower(path, 0.35)
    localizer = Localizer(landmark_map, Calibration.exact(world.mount), config)
    rng = np.random.default_rng([seed, 78])
    sigma = np.array(START_SIGMA)
    start = PoseEstimate(world.stamp_ns, pose + sigma * rng.normal(size=3), np.diag(sigma**2))
    localizer.add_odometry(world.odometry_sample())
    localizer.initialize(start)
    updates: list[LocalizationUpdate] = []
    truth: list[FloatArray] = []
    for k in range(round(seconds * STATE_RATE_HZ)):
        time_s = k / STATE_RATE_HZ
        world.command_velocity(*driver.command(world.true_pose))
        if k:
            localizer.add_odometry(world.odometry_sample())
        if k % (STATE_RATE_HZ // CAMERA_RATE_HZ) == 0:
            update = localizer.add_frame(world.camera_frame())
            if isinstance(update, LocalizationUpdate):
                updates.append(update)
                truth.append(world.true_pose)
                pan = rule(update, time_s)
                if pan is not None:
                    world.command_pan(pan)
        world.advance(1.0 / STATE_RATE_HZ)
    fused = np.array([update.fused.pose for update in updates])
    none = np.full(3, np.nan)
    found = [update.observation.fix for update in updates]
    fixes = np.array([fix.pose if isinstance(fix, PoseEstimate) else none for fix in found])
    lost = np.array([update.status == 'lost' for update in updates])
    return Run(pose_errors(fused, np.array(truth)), pose_errors(fixes, np.array(truth)), lost)


def _row(name, runs):
    fused = np.concatenate([run.fused for run in runs])
    fixes = np.concatenate([run.fixes for run in runs])
    off = summary(fused)
    return {
        f'{"camera":<24}': f'{name:<24}',
        'rmse_mm': off['rmse'],
        'p95_mm': off['p95'],
        'rmse_deg': off['heading'],
        'available': 1.0 - np.mean(np.concatenate([run.lost for run in runs])),
        'fixes': np.mean(np.isfinite(fixes[:, 0])),
        'fix_median_mm': summary(fixes)['median'],
    }
