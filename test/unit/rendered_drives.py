"""Seeded drives past walls of posters: a small camera, a map a few millimetres off."""

from dataclasses import dataclass, replace

import numpy as np
from scenes import draw_frame, rectangle_room, textured_room, true_landmark

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.types import Expectation, FloatArray, LandmarkMap, OdometrySample, PoseEstimate

LENS = CameraModel(
    400, 300, 330.0, 330.0, 200.0, 150.0, distortion=(-0.15, 0.05, 0.001, -0.001, 0.0)
)
MOUNT = PanTiltMount(axis_xyz=(0.12, 0.02, 1.15))
ROOM = rectangle_room(5.0, 4.5)
SCENE = textured_room(ROOM, seed=7, feature_m=0.045)
START = np.array([1.6, 1.4, 0.3])
START_SIGMA = np.array([0.03, 0.03, 0.01])
MAP_SIGMA_M = 0.003

ACROSS = (-0.32, -0.2, -0.05, 0.08, 0.2, 0.33)
FRAME_NS, ODOMETRY_NS = 400_000_000, 50_000_000


def known_map(rng):
    """Six landmarks a wall, each a few millimetres off."""
    viewpoint = np.array([2.5, 2.2, 1.15])
    landmarks = []
    for board in SCENE.boards:
        for across, up in zip(ACROSS, (0.1, -0.25, 0.2, -0.2, 0.15, -0.1), strict=True):
            exact = true_landmark(
                SCENE, len(landmarks) + 1, board, across * board.width_m, up, viewpoint,
                sigma_m=MAP_SIGMA_M,
            )  # fmt: skip
            error = rng.normal(0.0, MAP_SIGMA_M, 3)
            landmarks.append(replace(exact, position=exact.position + error))
    return LandmarkMap(tuple(landmarks), walls=ROOM.walls)


MAP = known_map(np.random.default_rng(0))


@dataclass(frozen=True, eq=False)
class Step:
    """Truth and wheel odometry at a time."""

    stamp_ns: int
    pose: FloatArray
    odometry: OdometrySample


def drive(rng, seconds):
    """Winding drive whose odometry runs 2 % long, drifts and is noisy."""
    pose, wheel = START.copy(), np.zeros(3)
    dt = ODOMETRY_NS * 1e-9
    for k in range(int(seconds / dt) + 1):
        speed, rate = 0.3, 0.35 * np.sin(0.8 * k * dt) + 0.1
        yield Step(k * ODOMETRY_NS, pose, OdometrySample(k * ODOMETRY_NS, wheel, speed, rate))
        pose = se2.compose(pose, [speed * dt, 0.0, rate * dt])
        noise = rng.normal(0.0, [2e-4, 1e-4, 4e-4])
        felt = np.array([1.02 * speed * dt, 0.0, (rate + 0.01 * speed) * dt]) + noise
        wheel = se2.compose(wheel, felt)


def camera_image(pose, pan, rng=None):
    return draw_frame(SCENE, LENS, MOUNT, pose, pan, rng=rng)


def expected(prior, sigma=1e-4):
    """What a filter expects that knows the camera to so many metres and radians."""
    known = Calibration.of_mount(MOUNT, dict.fromkeys(NAMES, sigma))
    return Expectation(prior.stamp_ns, prior.pose, prior.covariance, known, sigma)


def start_of(rng):
    return PoseEstimate(0, START + rng.normal(0.0, START_SIGMA), np.diag(START_SIGMA**2))
