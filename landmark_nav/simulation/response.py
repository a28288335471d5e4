"""
What a camera makes of light: values of pixels, by the curve of sRGB (IEC 61966-2-1).

Lens, pixels and edges that cover a pixel in part mix light, not values: an edge that they blur
seems to move towards its dark side.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.types import ImageArray

__all__ = ['LightArray', 'light_of', 'values_of']

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
