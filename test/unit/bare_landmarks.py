"""Landmarks of which the place alone matters, and the bearings at which they are seen."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.types import FloatArray, Landmark

__all__ = ['bare_landmark', 'bearings']


def bare_landmark(
    number: int, position: FloatArray, covariance: FloatArray, **given: Any
) -> Landmark:
    """Landmark without a picture, independent of others; `given` sets further fields."""
    fields: dict[str, Any] = {
        'shared_loading': np.zeros((3, 0)),
        'normal': np.array([1.0, 0.0, 0.0]),
        'width_m': 0.2,
        'height_m': 0.2,
        'patch': np.zeros((8, 8), np.uint8),
        'viewpoint': np.zeros(3),
        'threshold': 0.7,
    }
    return Landmark(number, position, covariance, **(fields | given))


def bearings(pose: FloatArray, places: FloatArray) -> FloatArray:
    """Counter-clockwise angles (n,) from the heading of `pose` (3,) to `places` (n, 2)."""
    delta = places - pose[:2]
    return wrap_rad(np.arctan2(delta[:, 1], delta[:, 0]) - pose[2])
