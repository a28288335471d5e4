"""Light of lamps on flat surfaces: cosine and distance, no shadows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from landmark_nav.simulation.scene import Lamp
from landmark_nav.types import FloatArray

__all__ = ['irradiance']


# Light that walls and ceiling throw back on everything, relative to the albedo shown as it is.
_AMBIENT = 0.55

# One lamp of power 1 adds this to a surface that faces it from one metre away.
_LAMP_GAIN = 1.5

# Lamps are wide: this keeps the light finite right beside one, metres.
_LAMP_RADIUS_M = 0.9


def irradiance(points: npt.ArrayLike, normal: npt.ArrayLike, lamps: Sequence[Lamp]) -> FloatArray:
    """
    Light on points of a plane.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Points on the surface, map frame, metres.
    normal : array_like, shape (3,)
        Unit normal of its lit side.
    lamps : sequence of Lamp
        What shines.

    Returns
    -------
    ndarray, shape (..., 3)
        Factor on the albedo's blue, green and red; about 1 in a usual room.

    """
    at = np.asarray(points, dtype=np.float64)
    light = np.full(at.shape, _AMBIENT)
    for lamp in lamps:
        offset = np.asarray(lamp.position) - at
        square = np.sum(offset**2, -1)
        cosine = np.clip(offset @ np.asarray(normal) / np.sqrt(square + 1e-9), 0.0, 1.0)
        # A wide lamp lights grazing surfaces too: soften the cosine.
        strength = _LAMP_GAIN * lamp.power * (0.25 + 0.75 * cosine) / (square + _LAMP_RADIUS_M)
        light += strength[..., None] * np.asarray(lamp.tint)
    return light
