"""Raw and compressed images, by docs/images.md, and the intrinsics of their cameras."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
import logging
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.image_codec import decode_image, image_size
from landmark_nav.messages.clouds import bytes_array
from landmark_nav.types import ImageArray

_LOG = logging.getLogger(__name__)

# Largest whole factor between the size of an image and that of its calibration.
_LARGEST_FACTOR = 8
# Another interpretation of K is used if the usual one puts the principal point farther than this
# from the centre (relative to the image size), and the other one less than half as far.
_MAX_OFF_CENTRE = 0.15
# Greatest displacement by a skew that is ignored, pixels; OpenCV's lens models have no skew.
_LARGEST_SKEW_PX = 1.0


# fx, fy, cx, cy.
_Intrinsics = tuple[float, float, float, float]


@dataclass(frozen=True)
class CameraInfo:
    """
    Content of a sensor_msgs/CameraInfo; the camera it means depends on the size of the image.

    `intrinsics` are fx, fy, cx, cy; `roi` is x, y, width, height, all in pixels.
    """

    size: tuple[int, int]
    intrinsics: _Intrinsics
    model: str
    distortion: tuple[float, ...]
    binning: tuple[int, int]
    roi: tuple[int, int, int, int]

    @property
    def camera(self) -> CameraModel:
        """Camera of the image size by region of interest and binning, before an image arrives."""
        try:
            return self.for_image(*self._usual_size)
        except LandmarkNavError:
            if self.size == self._usual_size:
                raise
            # The sizes may already be those of the reduced image.
            return self.for_image(*self.size)

    def for_image(self, width: int, height: int) -> CameraModel:
        """
        Camera of an image of some size.

        By definition K refers to the whole sensor, and region of interest and binning are applied
        to it. Some drivers publish K of the reduced image instead: the principal point decides.
        For images that are a whole factor larger or smaller, K is scaled.

        Raises `LandmarkNavError`: camera_info is for another size, or is not a calibrated camera.
        """
        return _camera(self, width, height)

    @property
    def _usual_size(self) -> tuple[int, int]:
        across, down = self.binning
        return (self.roi[2] or self.size[0]) // across, (self.roi[3] or self.size[1]) // down

    def readings(self, width: int, height: int) -> Iterator[_Intrinsics]:
        """Each fx, fy, cx, cy that K may mean for an image of some size, the usual one first."""
        fx, fy, cx, cy = self.intrinsics
        across, down = self.binning
        left, top, _, _ = self.roi
        # Pixel centres are integers: binning shifts them by half a pixel of either size.
        small = (
            fx / across,
            fy / down,
            (cx - left + 0.5) / across - 0.5,
            (cy - top + 0.5) / down - 0.5,
        )
        if (width, height) in (self._usual_size, self.size):
            yield small
            yield self.intrinsics
            return
        for size, (fx, fy, cx, cy) in ((self._usual_size, small), (self.size, self.intrinsics)):
            if n := _whole_factor(size, (width, height)):
                yield fx * n, fy * n, (cx + 0.5) * n - 0.5, (cy + 0.5) * n - 0.5

    @property
    def described(self) -> str:
        """Size, region of interest and binning, for a message."""
        words = f'{self.size[0]} x {self.size[1]}'
        if any(self.roi):
            words += ', region of interest {2} x {3} at {0}, {1}'.format(*self.roi)
        if self.binning != (1, 1):
            words += ', binning {} x {}'.format(*self.binning)
        return words


def camera_info(msg: Any) -> CameraInfo:
    """
    Calibration of a sensor_msgs/CameraInfo.

    Equal messages give the same camera objects, which cache their tables.

    Raises `LandmarkNavError`: not calibrated, an unsupported model, or a skew.
    """
    k = np.asarray(msg.k, dtype=np.float64)
    if not k.any():
        raise LandmarkNavError('camera_info is all zero: calibrate the camera')
    fx, skew, cx, _, fy, cy = k[:6].tolist()
    if abs(skew) * int(msg.height) > 2.0 * _LARGEST_SKEW_PX * abs(fy):
        raise LandmarkNavError(
            f'camera_info has a skew of {skew:g} (K[1]), which no model of ROS corrects: '
            'calibrate the camera without skew'
        )
    # Drivers pad the coefficients with zeros to different lengths.
    distortion = tuple(np.trim_zeros(np.asarray(msg.d, dtype=np.float64), 'b').tolist())
    # Simulators and rectified images name no model.
    model = str(msg.distortion_model) or ('' if distortion else 'plumb_bob')
    roi = msg.roi
    info = CameraInfo(
        (int(msg.width), int(msg.height)),
        (fx, fy, cx, cy),
        model,
        distortion,
        (max(1, int(msg.binning_x)), max(1, int(msg.binning_y))),
        (int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)),
    )
    _ = info.camera  # raises if this is not a camera
    return info


def camera_model(msg: Any) -> CameraModel:
    """Camera of a sensor_msgs/CameraInfo, in the pixels of the image that it describes."""
    return camera_info(msg).camera


@lru_cache(maxsize=32)
def _camera(info: CameraInfo, width: int, height: int) -> CameraModel:
    if width < 1 or height < 1:
        raise LandmarkNavError(
            f'camera_info or its image is of {width} x {height} px: set width and height of both'
        )
    readings = list(dict.fromkeys(info.readings(width, height)))
    if not readings:
        raise LandmarkNavError(
            f'image is {width} x {height}, but its camera_info is for {info.described}: calibrate '
            'at the size that is published, or a whole factor of it'
        )

    def off_centre(reading: _Intrinsics) -> float:
        """Distance of the principal point from the centre, relative to the image size."""
        _, _, cx, cy = reading
        return max(abs((cx + 0.5) / width - 0.5), abs((cy + 0.5) / height - 0.5))

    usual, *others = readings
    best = min(others, key=off_centre, default=usual)
    meant = ''
    if off_centre(usual) > _MAX_OFF_CENTRE and off_centre(best) < 0.5 * off_centre(usual):
        meant = f'by its principal point that of the image of {width} x {height}'
        usual = best
    elif others and off_centre(best) < _MAX_OFF_CENTRE:
        meant = (
            'that of the whole sensor, as ROS defines it, though it could be that of the reduced '
            'image'
        )
    camera = CameraModel(width, height, *usual, info.model, info.distortion)
    if meant:
        _LOG.warning('camera_info (%s): K is assumed to be %s', info.described, meant)
    if camera.restriction:
        _LOG.warning('camera_info: %s: calibrate it to use all', camera.restriction)
    if min(camera.reduced_size) < 1:
        raise LandmarkNavError(
            f'camera_info: {width} x {height} px with a focal length of {camera.fx:.3g} x '
            f'{camera.fy:.3g} px has almost no field of view: calibrate it'
        )
    return camera


def _whole_factor(size: tuple[int, int], image: tuple[int, int]) -> float:
    """Ratio of the image size to that of the calibration; 0 if neither divides the other."""
    for factor in range(2, _LARGEST_FACTOR + 1):
        if (size[0] * factor, size[1] * factor) == image:
            return float(factor)
        if (size[0] // factor, size[1] // factor) == image:
            return 1.0 / factor
    return 0.0


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
