"""Intrinsics out of camera_info, in the pixels of the image that it belongs to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
import logging
from typing import Any

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel

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
