"""Views of a room with six landmarks a wall, and whether a place found from them is right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scenes import draw_frame, rectangle_room, Scene, textured_room, true_landmark

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap, PoseEstimate, Refusal

LENS = CameraModel(
    400, 300, 330.0, 330.0, 200.0, 150.0, distortion=(-0.15, 0.05, 0.001, -0.001, 0.0)
)
MOUNT = PanTiltMount(axis_xyz=(0.12, 0.02, 1.15), optical_center_offset=(0.03, 0.01, 0.02))
ROOM = rectangle_room(5.0, 4.0)
SCENE = textured_room(ROOM, seed=7, feature_m=0.045)
ALONG = ((-0.33, 0.3), (-0.2, -0.3), (-0.05, 0.35), (0.1, -0.2), (0.22, 0.25), (0.34, -0.35))
PANS = np.radians(np.arange(-180, 180, 40))


def learned(scene: Scene) -> LandmarkMap:
    """Six landmarks a wall, at different heights."""
    landmarks = [
        true_landmark(
            scene, 10 * k + j, board, across * board.width_m, up, np.array([2.5, 2.0, 1.17])
        )
        for k, board in enumerate(scene.boards)
        for j, (across, up) in enumerate(ALONG)
    ]
    return LandmarkMap(tuple(landmarks), walls=ROOM.walls)


MAP = learned(SCENE)


def sweep(
    scene: Scene, pose: Sequence[float], pans: FloatArray = PANS, tilt_rad: float = 0.0
) -> list[CameraFrame]:
    rng = np.random.default_rng(3)
    return [
        draw_frame(
            scene, LENS, MOUNT, np.array(pose), float(p), tilt_rad, stamp_ns=k * 10**8, rng=rng
        )
        for k, p in enumerate(pans)
    ]


def assert_right(found: PoseEstimate | Refusal, pose: Sequence[float]) -> None:
    assert isinstance(found, PoseEstimate), str(found)
    error = found.pose - pose
    error[2] = wrap_rad(error[2])
    assert np.hypot(*error[:2]) < 0.02
    assert abs(error[2]) < np.radians(0.4)
    assert error @ np.linalg.solve(found.covariance, error) < 21.0  # 3 dof: one in 10 000
