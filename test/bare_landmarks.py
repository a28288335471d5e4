"""Landmarks without images: only their locations matter."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.patches import patch_axes
from landmark_nav.types import FloatArray, Landmark

__all__ = ['bare_landmark']


def bare_landmark(
    number: int, position: FloatArray, covariance: FloatArray, **given: Any
) -> Landmark:
    """Landmark without an image, independent of others; `given` sets further fields."""
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


def patch_points(
    position: npt.ArrayLike, normal: npt.ArrayLike, shape: tuple[int, int], texel_m: float
) -> FloatArray:
    """Points (rows, columns, 3) in map of the texels of a patch centred on `position`."""
    right, down = patch_axes(normal)
    column = (np.arange(shape[1]) - (shape[1] - 1) / 2.0) * texel_m
    row = (np.arange(shape[0]) - (shape[0] - 1) / 2.0) * texel_m
    return np.asarray(
        np.asarray(position) + column[None, :, None] * right + row[:, None, None] * down
    )
