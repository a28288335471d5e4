"""Raw and compressed images; docs/images.md lists the supported encodings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.image_codec import decode_image, image_size
from landmark_nav.messages.clouds import bytes_array
from landmark_nav.messages.decode.cameras import CameraInfo
from landmark_nav.types import ImageArray

_Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

# Bits of usual analogue-to-digital converters.
_DEPTHS = (8, 10, 12, 14, 16)

# First byte of a PNG.
_PNG = b'\x89'
# Modes that decode a JPEG at a part of its size, averaged.
_REDUCED = {
    2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
    4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8,
}


@dataclass(frozen=True)
class _Layout:
    """
    Layout of pixels in memory, and the OpenCV conversions to BGR and grey (None: none needed).

    `rows` is the number of rows of the buffer for two rows of the image. With `first`, only the
    first channel is used.
    """

    channels: int
    to_bgr: int | None = None
    to_grey: int | None = None
    rows: int = 2
    first: bool = False


# Encodings, with {} for 8 or 16 bits a channel.
_BY_DEPTH = {
    'mono{} {}UC1': _Layout(1),
    '{}UC2': _Layout(2, first=True),
    'bgr{} {}UC3': _Layout(3, None, cv2.COLOR_BGR2GRAY),
    'rgb{}': _Layout(3, cv2.COLOR_RGB2BGR, cv2.COLOR_RGB2GRAY),
    'bgra{} {}UC4': _Layout(4, cv2.COLOR_BGRA2BGR, cv2.COLOR_BGRA2GRAY),
    'rgba{}': _Layout(4, cv2.COLOR_RGBA2BGR, cv2.COLOR_RGBA2GRAY),
    # OpenCV names a Bayer pattern by its second row, from the second column on.
    'bayer_rggb{}': _Layout(1, cv2.COLOR_BayerBG2BGR, cv2.COLOR_BayerBG2GRAY),
    'bayer_bggr{}': _Layout(1, cv2.COLOR_BayerRG2BGR, cv2.COLOR_BayerRG2GRAY),
    'bayer_gbrg{}': _Layout(1, cv2.COLOR_BayerGR2BGR, cv2.COLOR_BayerGR2GRAY),
    'bayer_grbg{}': _Layout(1, cv2.COLOR_BayerGB2BGR, cv2.COLOR_BayerGB2GRAY),
}
_YUV = {
    'yuv422 uyvy': _Layout(2, cv2.COLOR_YUV2BGR_UYVY, cv2.COLOR_YUV2GRAY_UYVY),
    'yuv422_yuy2 yuyv': _Layout(2, cv2.COLOR_YUV2BGR_YUY2, cv2.COLOR_YUV2GRAY_YUY2),
    'nv12': _Layout(1, cv2.COLOR_YUV2BGR_NV12, cv2.COLOR_YUV2GRAY_NV12, rows=3),
    'nv21': _Layout(1, cv2.COLOR_YUV2BGR_NV21, cv2.COLOR_YUV2GRAY_NV21, rows=3),
}
# Encoding -> type of a channel, layout.
_LAYOUTS = {
    name.format(bits): (f'u{bits // 8}', layout)
    for names, layout in _BY_DEPTH.items()
    for name in names.split()
    for bits in (8, 16)
} | {name: ('u1', layout) for names, layout in _YUV.items() for name in names.split()}


@dataclass
class BitDepth:
    """
    Number of bits that a stream of 16-bit images uses, from the largest value so far.

    A camera of 10 or 12 bits uses the lower bits of `mono16`. The depth never decreases, so that
    grey levels do not change from image to image.
    """

    bits: int = 8

    def to_bytes(self, pixels: _Pixels) -> ImageArray:
        """Return the upper eight of the used bits; images of 8 bits unchanged."""
        if pixels.dtype == np.uint8:
            return np.asarray(pixels, dtype=np.uint8)
        needed = int(pixels.max(initial=0)).bit_length()
        self.bits = max(self.bits, next(bits for bits in _DEPTHS if bits >= needed))
        return np.asarray(pixels >> (self.bits - 8), dtype=np.uint8)

    def lowered(self, pixels: ImageArray, bits: int) -> ImageArray:
        """Rescale pixels that were decoded with a depth of `bits` to the depth known now."""
        return np.asarray(pixels >> max(self.bits - bits, 0), dtype=np.uint8)


def image(msg: Any, grey: bool = False, depth: BitDepth | None = None) -> ImageArray:
    """
    Pixels of a sensor_msgs/Image or CompressedImage: BGR (h, w, 3) or grey (h, w), uint8.

    With `grey`, colour images are converted to grey; a JPEG is then decoded in two thirds of the
    time. `depth` belongs to the stream of the image; without it, the image is decoded on its own.
    """
    return (depth or BitDepth()).to_bytes(_pixels(msg, grey, 1))


def camera_image(
    msg: Any, info: CameraInfo, grey: bool = False, depth: BitDepth | None = None
) -> tuple[ImageArray, CameraModel]:
    """
    Pixels of an image as in `image`, reduced to the size of `CameraModel.reduced`, and its camera.

    Pixels are averaged by area. The size is checked before anything is decoded. Raises
    `LandmarkNavError` also if the calibration is for images of another size.
    """
    width, height = published_size(msg)
    full = info.for_image(width, height)
    camera = full.reduced
    # A JPEG is decoded faster at a half, quarter or eighth of its size; that is exact only if the
    # factor divides its sides.
    fits = [n for n in (8, 4, 2) if n * camera.width <= width and not (width % n or height % n)]
    share = fits[0] if fits else 1
    pixels: Any = _pixels(msg, grey, share)
    if pixels.shape[:2] != (camera.height, camera.width):
        size = (camera.width, camera.height)
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return (depth or BitDepth()).to_bytes(pixels), camera


def image_bgra(msg: Any) -> ImageArray:
    """Pixels of a sensor_msgs/Image ``bgra8``, with alpha, (h, w, 4)."""
    if msg.encoding != 'bgra8':
        raise LandmarkNavError(f'panorama image is {msg.encoding!r}: publish it as bgra8')
    return np.asarray(_buffer(msg)[0], dtype=np.uint8)


def published_size(msg: Any) -> tuple[int, int]:
    """Width and height of a raw or compressed image, without decoding it."""
    if hasattr(msg, 'encoding'):
        return int(msg.width), int(msg.height)
    with _format_in_errors(msg):
        return image_size(bytes_array(msg.data))


def _pixels(msg: Any, grey: bool, share: int) -> _Pixels:
    """Grey or BGR pixels of 8 or 16 bits; a JPEG at a `share`-th of its size."""
    if not hasattr(msg, 'encoding'):
        return _compressed(msg, grey, share)
    pixels, layout = _buffer(msg)
    return _converted(pixels, layout, grey)


def _converted(pixels: _Pixels, layout: _Layout, grey: bool) -> _Pixels:
    if layout.first:
        return pixels[..., 0]
    conversion = layout.to_grey if grey else layout.to_bgr
    if conversion is None:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, conversion))  # type: ignore[return-value]
    except cv2.error as error:
        raise LandmarkNavError(
            f'image of {pixels.shape[1]} x {pixels.shape[0]} is too small for its encoding, or of '
            'an odd size: its publisher is broken'
        ) from error


def _buffer(msg: Any) -> tuple[_Pixels, _Layout]:
    """Channels of a raw image without the padding of rows, (h, w[, channels]), and its layout."""
    encoding = str(msg.encoding)
    if encoding not in _LAYOUTS:
        raise LandmarkNavError(
            f'image encoding {encoding[:40]!r} is not supported: publish bgr8, mono8 or another '
            'of docs/images.md'
        )
    kind, layout = _LAYOUTS[encoding]
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    used = width * layout.channels * int(kind[1])
    rows = height * layout.rows // 2
    data = bytes_array(msg.data)
    if not height or not width or step < used or len(data) < step * rows:
        raise LandmarkNavError(
            f'image of {width} x {height} {encoding} has rows of {step} bytes and {len(data)} '
            'bytes in all: its publisher is broken'
        )
    packed = np.ascontiguousarray(data[: step * rows].reshape(rows, step)[:, :used])
    if kind == 'u2':
        packed = packed.view('>u2' if msg.is_bigendian else '<u2').astype(np.uint16, copy=False)
    shape = (rows, width) if layout.channels == 1 else (rows, width, layout.channels)
    return packed.reshape(shape), layout


def _compressed(msg: Any, grey: bool, share: int) -> _Pixels:
    """Decode by the content of the data; the orientation tag is ignored, as in ROS."""
    kind = str(msg.format)
    if 'compresseddepth' in kind.lower():
        raise LandmarkNavError(f'image of format {kind[:40]!r} is not supported: publish jpeg')
    data = bytes_array(msg.data)
    mode = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_ANYCOLOR
    if data[:1].tobytes() == _PNG:
        mode |= cv2.IMREAD_ANYDEPTH
    elif share > 1:
        mode = _REDUCED[share] | (0 if grey else cv2.IMREAD_COLOR)
    with _format_in_errors(msg):
        pixels = decode_image(data, mode | cv2.IMREAD_IGNORE_ORIENTATION)
    mosaic = _LAYOUTS.get(kind.split(';')[0].strip(), ('', None))[1]
    if mosaic is not None and kind.startswith('bayer') and pixels.ndim == 2:
        return _converted(pixels, mosaic, grey)  # type: ignore[arg-type]
    return pixels  # type: ignore[return-value]


@contextmanager
def _format_in_errors(msg: Any) -> Iterator[None]:
    """Add the format of an image to errors."""
    try:
        yield
    except LandmarkNavError as error:
        raise LandmarkNavError(
            f'{str(msg.format)[:40]!r} of {len(msg.data)} bytes does not decode as jpeg: {error}'
        ) from error
