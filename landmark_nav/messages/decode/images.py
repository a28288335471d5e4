"""Pictures."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.buffers import bytes_array
from landmark_nav.types import ImageArray

__all__ = ['image', 'image_bgra']

# Encoding -> bytes per pixel, and the conversion to grey or BGR (None: as it is).
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    'mono8': (1, None),
    '8UC1': (1, None),
    'bgr8': (3, None),
    '8UC3': (3, None),
    'rgb8': (3, cv2.COLOR_RGB2BGR),
    'bgra8': (4, cv2.COLOR_BGRA2BGR),
    'rgba8': (4, cv2.COLOR_RGBA2BGR),
    'mono16': (2, None),
}


def image(msg: Any, grey: bool = False) -> ImageArray:
    """
    Picture of a sensor_msgs/Image or CompressedImage: BGR (h, w, 3) or grey (h, w), uint8.

    With `grey`, coloured ones become grey; a JPEG is then decoded in two thirds of the time.

    Raises
    ------
    LandmarkNavError
        Unknown encoding, sizes that contradict each other, or bytes that are not a picture.

    """
    if not hasattr(msg, 'encoding'):
        return _compressed(msg, cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_ANYCOLOR)
    picture = _raw(msg)
    return (
        np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
        if grey and picture.ndim == 3
        else picture
    )


def _raw(msg: Any) -> ImageArray:
    pixels = _pixels(msg)
    if msg.encoding == 'mono16':
        words = pixels.view('>u2' if msg.is_bigendian else '<u2')[..., 0]
        return np.asarray(words >> 8, dtype=np.uint8)
    conversion = _ENCODINGS[msg.encoding][1]
    if conversion is not None:
        return np.asarray(cv2.cvtColor(pixels, conversion))
    return pixels[..., 0] if pixels.shape[2] == 1 else pixels


def image_bgra(msg: Any) -> ImageArray:
    """
    Picture of a sensor_msgs/Image whose alpha means something, (h, w, 4).

    Raises
    ------
    LandmarkNavError
        Another encoding than ``bgra8``, or sizes that contradict each other.

    """
    if msg.encoding != 'bgra8':
        raise LandmarkNavError(f'panorama image is {msg.encoding!r}: publish it as bgra8')
    return _pixels(msg)


def _pixels(msg: Any) -> ImageArray:
    """Bytes of a raw picture without the padding of its rows, (h, w, bytes per pixel)."""
    if msg.encoding not in _ENCODINGS:
        raise LandmarkNavError(
            f'image encoding {msg.encoding!r} is not supported: '
            f'publish one of {", ".join(sorted(_ENCODINGS))}, or jpeg or png'
        )
    size = _ENCODINGS[msg.encoding][0]
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    data = bytes_array(msg.data)
    if not height or not width or step < width * size or len(data) < step * height:
        raise LandmarkNavError(
            f'image of {width} x {height} {msg.encoding} has rows of {step} bytes and '
            f'{len(data)} bytes in all: its publisher is broken'
        )
    rows = data[: step * height].reshape(height, step)[:, : width * size]
    return np.ascontiguousarray(rows).reshape(height, width, size)


def _compressed(msg: Any, mode: int) -> ImageArray:
    kind = str(msg.format)
    known = any(name in kind.lower() for name in ('jpeg', 'jpg', 'png'))
    if not known or 'compresseddepth' in kind.lower():
        raise LandmarkNavError(
            f'compressed image of format {kind!r} is not supported: publish jpeg or png'
        )
    data = bytes_array(msg.data)
    try:
        picture = cv2.imdecode(data, mode) if len(data) else None
    except cv2.error:
        picture = None
    if picture is None:
        raise LandmarkNavError(
            f'compressed image of {len(data)} bytes does not decode as {kind!r}: '
            'it is damaged or its format is wrong'
        )
    return np.asarray(picture, dtype=np.uint8)
