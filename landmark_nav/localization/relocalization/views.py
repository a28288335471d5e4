"""Which images add something new."""

from __future__ import annotations

import math

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.types import CameraFrame, FloatArray

__all__ = ['shows_new', 'view_direction']

# An image adds something new if it looks this share of half the field of view elsewhere, aside
# or up, or from this far away.
_NEW_VIEW = 0.9
_NEW_PLACE_M = 0.6


def view_direction(frame: CameraFrame, mount: PanTiltMount) -> FloatArray:
    """Azimuth and elevation (2,) in the base frame that an image looks along, radians."""
    turn, _ = mount.camera_pose_base(frame.pan_rad, frame.tilt_rad)
    x, y, z = turn[:, 2].tolist()
    return np.array([math.atan2(y, x), math.atan2(z, math.hypot(x, y))])


def shows_new(
    frame: CameraFrame, direction: FloatArray, directions: FloatArray, poses: FloatArray
) -> bool:
    """
    Whether an image shows more of the room than earlier ones.

    Parameters
    ----------
    frame : CameraFrame
        The image.
    direction : ndarray, shape (2,)
        Its `view_direction`.
    directions : ndarray, shape (n, 2)
        Those of the earlier images, each in its own base frame.
    poses : ndarray, shape (n, 3)
        Poses of the base at the earlier images, in the base frame of this one.

    """
    off = np.reshape(directions, (-1, 2)) - direction
    off[:, 0] = wrap_rad(off[:, 0] + poses[:, 2])
    half = frame.camera.half_fov_rad * np.array([1.0, frame.camera.height / frame.camera.width])
    same = np.all(np.abs(off) < _NEW_VIEW * half, axis=1)
    near = np.hypot(*poses[:, :2].T) < _NEW_PLACE_M
    return not np.any(same & near)
