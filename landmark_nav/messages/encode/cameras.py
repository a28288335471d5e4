"""Camera calibration."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.geometry.camera import CameraModel
from landmark_nav.messages.encode.headers import header
from landmark_nav.messages.factory import MessageFactory

__all__ = ['camera_info']


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
