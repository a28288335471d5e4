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


@pytest.mark.parametrize(
    ('trajectory', 'images', 'message'),
    [
        (TRAJECTORY, {}, 'lacks all of its 5 frames'),
        ([], IMAGES, 'no frames'),
        (
            [JointSample(10**9 * k, 5.0 * k, 0.01) for k in range(1, 6)],
            IMAGES,
            'the pan goes over 20 rad: are these degrees',
        ),
    ],
)
def test_what_is_no_sweep_is_refused(trajectory, images, message) -> None:
    with pytest.raises(LandmarkNavError, match=message):
        assemble_sweep(trajectory, images)
