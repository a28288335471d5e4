"""A camera that shows the same image again and again."""

from __future__ import annotations

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import relative
from landmark_nav.types import CameraFrame, FloatArray, ImageArray, OdometrySample

__all__ = ['FrozenImage']

# A camera that turned by so many pixels, or moved by so much, sees another image.
_MOVED_PX, _MOVED_M = 1.0, 0.02


class FrozenImage:
    """
    Recognises images that equal an earlier one although the camera has moved.

    Joints and odometry show whether it has: a pose in map is also put right where nothing moves.
    """

    def __init__(self) -> None:
        self._pose_odom: FloatArray = np.zeros(3)
        self._first: tuple[CameraFrame, FloatArray] | None = None

    def add_odometry(self, sample: OdometrySample) -> None:
        """Move on."""
        self._pose_odom = sample.pose_odom_base

    def repeats(self, frame: CameraFrame) -> bool:
        """Whether an image, taken after the last odometry, equals one from elsewhere exactly."""
        if self._first is None or not _same(frame.image, self._first[0].image):
            self._first = frame, self._pose_odom
            return False
        before, there = self._first
        if not np.ptp(frame.image):
            # The lens is covered: then all images are the same.
            return False
        forward, left, heading = relative(there, self._pose_odom).tolist()
        aside = wrap_rad(frame.pan_rad + heading - before.pan_rad)
        turn = max(abs(float(aside)), abs(frame.tilt_rad - before.tilt_rad))
        return turn * frame.camera.fx > _MOVED_PX or np.hypot(forward, left) > _MOVED_M


def _same(image: ImageArray, other: ImageArray) -> bool:
    # A few rows distinguish almost all images.
    few = slice(None, None, 16)
    return np.array_equal(image[few], other[few]) and np.array_equal(image, other)
