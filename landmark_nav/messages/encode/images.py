"""Images, camera_info and panoramas."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from landmark_nav.geometry.camera import CameraModel, INTRINSICS
from landmark_nav.image_codec import encode_image
from landmark_nav.messages.factory import (
    header,
    MessageFactory,
    pose_with_covariance,
    UPRIGHT,
)
from landmark_nav.types import ImageArray, Panorama


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


def camera_info(factory: MessageFactory, camera: CameraModel, stamp_ns: int, frame_id: str) -> Any:
    """Build a sensor_msgs/CameraInfo."""
    return factory(
        'sensor_msgs/msg/CameraInfo',
        header=header(factory, stamp_ns, frame_id),
        width=camera.width,
        height=camera.height,
        distortion_model=camera.model,
        d=camera.coefficients,
        k=camera.matrix.reshape(-1),
        r=np.eye(3).reshape(-1),
        p=np.hstack([camera.matrix, np.zeros((3, 1))]).reshape(-1),
    )


def panorama(
    factory: MessageFactory, view: Panorama, frame_id: str = 'map'
) -> tuple[Any, Any, Any]:
    """
    Build ``panorama/image`` (alpha is the mask), ``panorama/camera_info`` and ``panorama/pose``.

    The pose is that of the optical centre with the orientation of the base. `d` of camera_info
    holds values, covariance and intrinsics of the calibration, `made_with` and `by_calibration`.
    """
    alpha = np.where(view.mask, np.uint8(255), np.uint8(0))
    stamp = header(factory, view.stamp_ns, frame_id)
    cylinder, known, calibrated = view.cylinder, view.calibration, np.zeros(0)
    if known is not None and view.made_with is not None and view.by_calibration is not None:
        lens = np.zeros(INTRINSICS) if known.intrinsics is None else known.intrinsics
        parts = known.values, known.covariance, lens, view.made_with, view.by_calibration
        calibrated = np.concatenate([part.ravel() for part in parts])
    info = factory(
        'sensor_msgs/msg/CameraInfo',
        header=stamp,
        width=cylinder.width,
        height=cylinder.height,
        distortion_model='cylindrical',
        d=calibrated,
        k=np.array([cylinder.fx, 0.0, cylinder.cx, 0.0, cylinder.fy, cylinder.cy, 0.0, 0.0, 1.0]),
    )
    x, y, z = view.center_map
    place = factory(
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        header=stamp,
        pose=pose_with_covariance(factory, (x, y, z, view.heading_rad), view.covariance, UPRIGHT),
    )
    pixels = np.dstack([view.image, alpha])
    return image(factory, pixels, view.stamp_ns, frame_id), info, place
