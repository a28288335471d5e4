"""Panoramas: image, geometry and place go as three messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.messages.encode.headers import header, pose_with_covariance
from landmark_nav.messages.encode.images import image
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.messages.layouts import UPRIGHT
from landmark_nav.types import Panorama

__all__ = ['panorama']


def panorama(
    factory: MessageFactory, view: Panorama, frame_id: str = 'map'
) -> tuple[Any, Any, Any]:
    """
    Build ``panorama/image`` (alpha is the mask), ``panorama/camera_info`` and ``panorama/pose``.

    The pose is of the optical centre, turned as the base was.
    """
    alpha = np.where(view.mask, np.uint8(255), np.uint8(0))
    stamp = header(factory, view.stamp_ns, frame_id)
    cylinder = view.cylinder
    info = factory(
        'sensor_msgs/msg/CameraInfo',
        header=stamp,
        width=cylinder.width,
        height=cylinder.height,
        distortion_model='cylindrical',
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
