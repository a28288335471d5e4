"""Angles and images are joined by their stamps."""

from __future__ import annotations

import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.learning.sweep import assemble_sweep
from landmark_nav.types import JointSample

CAMERA = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
TRAJECTORY = [JointSample(10**9 * k, 0.1 * k, 0.01) for k in range(1, 6)]
IMAGES = {10**9 * k: (np.full((48, 64), k, np.uint8), CAMERA) for k in range(8)}


def test_frames_of_the_trajectory_in_order_of_time() -> None:
    sweep = assemble_sweep(TRAJECTORY[::-1], IMAGES)
    assert [frame.stamp_ns for frame in sweep.frames] == [s.stamp_ns for s in TRAJECTORY]
    assert [int(frame.image[0, 0]) for frame in sweep.frames] == [1, 2, 3, 4, 5]
    assert [frame.pan_rad for frame in sweep.frames] == [s.pan_rad for s in TRAJECTORY]
    assert sweep.frames[0].tilt_rad == 0.01


def test_missing_frames_are_named_by_their_angles(caplog: pytest.LogCaptureFixture) -> None:
    some = {stamp: IMAGES[stamp] for stamp in IMAGES if stamp not in (2 * 10**9, 5 * 10**9)}
    sweep = assemble_sweep(TRAJECTORY, some)
    assert [frame.stamp_ns for frame in sweep.frames] == [10**9, 3 * 10**9, 4 * 10**9]
    assert '2 frames are missing, at pan 11, 29 deg; nothing is seen from pan 51' in caplog.text


def test_not_one_image() -> None:
    with pytest.raises(LandmarkNavError, match='lacks all of its 5 frames'):
        assemble_sweep(TRAJECTORY, {})


def test_no_angles() -> None:
    with pytest.raises(LandmarkNavError, match='no frames'):
        assemble_sweep([], IMAGES)


def test_angles_in_degrees_are_reported() -> None:
    degrees = [JointSample(10**9 * k, 5.0 * k, 0.01) for k in range(1, 6)]
    with pytest.raises(LandmarkNavError, match='the pan goes over 20 rad: are these degrees'):
        assemble_sweep(degrees, IMAGES)
