"""Images."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from landmark_nav.image_codec import encode_image
from landmark_nav.messages.encode.headers import header
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.types import ImageArray

__all__ = ['compressed_image', 'image']


def image(factory: MessageFactory, pixels: ImageArray, stamp_ns: int, frame_id: str) -> Any:
    """Build a sensor_msgs/Image of grey (h, w), BGR (h, w, 3) or BGRA (h, w, 4)."""
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    height, width = pixels.shape[:2]
    return factory(
        'sensor_msgs/msg/Image',
        header=header(factory, stamp_ns, frame_id),
        height=height,
        width=width,
        encoding={1: 'mono8', 3: 'bgr8', 4: 'bgra8'}[channels],
        is_bigendian=0,
        step=width * channels,
        data=np.ascontiguousarray(pixels).reshape(-1),
    )


def compressed_image(
    factory: MessageFactory,
    pixels: ImageArray,
    stamp_ns: int,
    frame_id: str,
    jpeg_quality: int = 90,
) -> Any:
    """Build a sensor_msgs/CompressedImage (JPEG) of grey (h, w) or BGR (h, w, 3)."""
    return factory(
        'sensor_msgs/msg/CompressedImage',
        header=header(factory, stamp_ns, frame_id),
        format='jpeg',
        data=encode_image(pixels, '.jpg', [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]),
    )
