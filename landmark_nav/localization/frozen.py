"""A camera that shows the same picture again and again."""

from __future__ import annotations

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.types import CameraFrame, ImageArray, PoseEstimate

__all__ = ['FrozenPicture']

# A camera that turned by so many pixels, or moved by so much, sees another picture.
_MOVED_PX, _MOVED_M = 1.0, 0.02


class FrozenPicture:
    """Recognises pictures that equal an earlier one although the camera has moved."""

    def __init__(self) -> None:
        self._first: tuple[CameraFrame, PoseEstimate] | None = None

    def repeats(self, frame: CameraFrame, pose: PoseEstimate) -> bool:
        """Whether a picture, taken at a pose of the base, equals one from elsewhere exactly."""
        if self._first is None or not _same(frame.image, self._first[0].image):
            self._first = frame, pose
            return False
        before, there = self._first
        if not np.ptp(frame.image):
            # The lens is covered: then all pictures are the same.
            return False
        aside = wrap_rad(frame.pan_rad + pose.pose[2] - before.pan_rad - there.pose[2])
        turn = max(abs(float(aside)), abs(frame.tilt_rad - before.tilt_rad))
        way = float(np.hypot(*(pose.pose - there.pose)[:2]))
        return turn * frame.camera.fx > _MOVED_PX or way > _MOVED_M


def _same(image: ImageArray, other: ImageArray) -> bool:
    # A few rows tell almost all pictures apart.
    few = slice(None, None, 16)
    return np.array_equal(image[few], other[few]) and np.array_equal(image, other)
