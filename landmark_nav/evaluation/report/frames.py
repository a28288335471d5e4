"""Reduced copies of the images of a drive for a page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np

from landmark_nav.image_codec import encode_image
from landmark_nav.storage.bags import SensorEvent
from landmark_nav.types import CameraFrame

# Greatest size of all copies: 11 MB in base64, for a page of 15 MB with 4 MB of other data.
_BUDGET_BYTES = 8_000_000
_WIDTH_PX = 480
_QUALITY = 60


class FrameStrip:
    """
    Small JPEG copies of images, evenly thinned to `budget_bytes` for a drive of any length.

    `frames` holds all frames without their pixels, `jpegs` the kept copies; both by stamp in
    nanoseconds.
    """

    def __init__(self, budget_bytes: int = _BUDGET_BYTES) -> None:
        self.frames: dict[int, CameraFrame] = {}
        self.jpegs: dict[int, bytes] = {}
        self._budget, self._bytes, self._stride = budget_bytes, 0, 1

    def watch(self, events: Iterable[SensorEvent]) -> Iterator[SensorEvent]:
        """Yield the events unchanged, and keep copies of their images."""
        for event in events:
            if isinstance(event, CameraFrame):
                self.add(event)
            yield event

    def add(self, frame: CameraFrame) -> None:
        """Keep a copy of an image if its index is a multiple of the stride."""
        if len(self.frames) % self._stride == 0:
            self.jpegs[frame.stamp_ns] = copied = jpeg(frame.image, _WIDTH_PX, _QUALITY)
            self._bytes += len(copied)
        self.frames[frame.stamp_ns] = replace(frame, image=np.empty((0, 0), np.uint8))
        while self._bytes > self._budget and len(self.jpegs) > 1:
            self.jpegs = dict(list(self.jpegs.items())[::2])
            self._stride *= 2
            self._bytes = sum(map(len, self.jpegs.values()))


def jpeg(image: np.ndarray, most_px: int, quality: int) -> bytes:
    """Encode an image, grey or BGR, reduced to a width of at most `most_px`."""
    scale = min(1.0, most_px / image.shape[1])
    if scale < 1.0:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return encode_image(image, '.jpg', (cv2.IMWRITE_JPEG_QUALITY, quality)).tobytes()
