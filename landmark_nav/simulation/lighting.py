"""
Light of lamps on flat surfaces: cosine and distance, no shadows.

What a camera makes of light: values of pixels, by the curve of sRGB (IEC 61966-2-1).

Lens, pixels and edges that cover a pixel in part mix light, not values: an edge that they blur
seems to move towards its dark side.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.simulation.scene import Lamp
from landmark_nav.types import FloatArray, ImageArray

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


LightArray = npt.NDArray[np.uint16]

_MOST = 65535


def _curve() -> LightArray:
    value = np.arange(256) / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.rint(_MOST * light), dtype=np.uint16)


_LIGHT = _curve()
# The value whose light is nearest.
_VALUE = np.searchsorted(0.5 * (_LIGHT[1:] + _LIGHT[:-1].astype(float)), np.arange(_MOST + 1))
_VALUE = _VALUE.astype(np.uint8)


def light_of(values: ImageArray) -> LightArray:
    """Light, 65535 at the most, of values of pixels (height, ..., channels); of the same shape."""
    flat = values.reshape(len(values), -1)
    return np.asarray(cv2.LUT(flat, _LIGHT), dtype=np.uint16).reshape(values.shape)


def values_of(light: LightArray) -> ImageArray:
    """Values of pixels that show this light."""
    return np.asarray(_VALUE[light], dtype=np.uint8)
