"""Camera calibration."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel

__all__ = ['camera_model']


def camera_model(msg: Any) -> CameraModel:
    """
    Camera of a sensor_msgs/CameraInfo, in the pixels of the image it belongs to.

    Calibrations are given at full resolution: region of interest and binning are applied here.
    Equal messages give the same object, which keeps what it computed once.

    Raises
    ------
    LandmarkNavError
        Unknown distortion model, or values that are not a calibrated camera.

    """
    k = np.asarray(msg.k, dtype=np.float64)
    # Drivers pad the coefficients with zeros, each to a length of its own.
    distortion = np.trim_zeros(np.asarray(msg.d, dtype=np.float64), 'b')
    return _camera(
        (int(msg.width), int(msg.height)),
        (k[0], k[4], k[2], k[5]),
        str(msg.distortion_model),
        tuple(float(value) for value in distortion),
        (max(1, int(msg.binning_x)), max(1, int(msg.binning_y))),
        (
            int(msg.roi.x_offset),
            int(msg.roi.y_offset),
            int(msg.roi.width),
            int(msg.roi.height),
        ),
    )


@lru_cache(maxsize=16)
def _camera(
    size: tuple[int, int],
    intrinsics: tuple[float, float, float, float],
    model: str,
    distortion: tuple[float, ...],
    binning: tuple[int, int],
    roi: tuple[int, int, int, int],
) -> CameraModel:
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    if not any((fx, fy, cx, cy)):
        raise LandmarkNavError('camera_info is all zero: calibrate the camera')
    left, top = roi[:2]
    width, height = roi[2] or size[0], roi[3] or size[1]
    # Pixel centres are integers: binning moves them by half a pixel of either size.
    return CameraModel(
        width=width // binning[0],
        height=height // binning[1],
        fx=fx / binning[0],
        fy=fy / binning[1],
        cx=(cx - left + 0.5) / binning[0] - 0.5,
        cy=(cy - top + 0.5) / binning[1] - 0.5,
        model=model,
        distortion=distortion,
    )
