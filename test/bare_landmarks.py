"""Landmarks without images: only their locations matter."""

from __future__ import annotations

from typing import Any

import numpy as np

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
