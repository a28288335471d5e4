"""Rotations in space."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray

__all__ = ['rot_x', 'rot_y', 'rot_z', 'rotation_rpy']


def rotation_rpy(rpy_rad: npt.ArrayLike) -> FloatArray:
    """Rotation (3, 3) of fixed-axis roll, pitch, yaw: Rz(yaw) Ry(pitch) Rx(roll), as in URDF."""
    roll, pitch, yaw = np.asarray(rpy_rad, dtype=np.float64)
    return np.asarray(rot_z(yaw) @ rot_y(pitch) @ rot_x(roll))


def rot_x(angle: Any) -> FloatArray:
    """Rotations (..., 3, 3) by angles (...) about x, radians."""
    return _rotation_about(0, angle)


def rot_y(angle: Any) -> FloatArray:
    """Rotations (..., 3, 3) by angles (...) about y, radians."""
    return _rotation_about(1, angle)


def rot_z(angle: Any) -> FloatArray:
    """Rotations (..., 3, 3) by angles (...) about z, radians."""
    return _rotation_about(2, angle)


def _rotation_about(axis: int, angle: Any) -> FloatArray:
    # Most are single angles, which `math` is quicker with.
    single = np.ndim(angle) == 0
    cos, sin = (math.cos(angle), math.sin(angle)) if single else (np.cos(angle), np.sin(angle))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((*np.shape(angle), 3, 3))
    out[..., axis, axis] = 1.0
    out[..., first, first] = out[..., second, second] = cos
    out[..., first, second] = -sin
    out[..., second, first] = sin
    return out
