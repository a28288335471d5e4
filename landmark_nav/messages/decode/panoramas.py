"""Panoramas: image, geometry and place come as three messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.messages.decode.headers import finite, stamp_ns, yaw_rad
from landmark_nav.messages.decode.images import image_bgra
from landmark_nav.messages.decode.poses import FARTHEST_M, pose_covariance
from landmark_nav.messages.layouts import UPRIGHT
from landmark_nav.types import Panorama

__all__ = ['panorama']

# Of a focal length or a principal point.
_MOST_PX = 1e6


def panorama(image_msg: Any, info_msg: Any, pose_msg: Any) -> Panorama:
    """
    Panorama out of ``panorama/image``, ``panorama/camera_info`` and ``panorama/pose``.

    Raises
    ------
    LandmarkNavError
        The three do not belong together, or the geometry is not cylindrical.

    """
    stamp = stamp_ns(image_msg.header)
    others = (stamp_ns(info_msg.header), stamp_ns(pose_msg.header))
    if others != (stamp, stamp):
        raise LandmarkNavError(
            f'panorama image of {stamp * 1e-9:.3f} s comes with geometry of '
            f'{others[0] * 1e-9:.3f} s and a pose of {others[1] * 1e-9:.3f} s'
        )
    if info_msg.distortion_model != 'cylindrical':
        raise LandmarkNavError(
            f'panorama has the camera model {info_msg.distortion_model!r:.60}, not cylindrical'
        )
    k = finite(info_msg.k, 'panorama geometry', stamp, _MOST_PX, count=9)
    cylinder = Cylinder(int(info_msg.width), int(info_msg.height), k[4], k[2], k[5])
    if cylinder.fy <= 0.0 or abs(k[0] - cylinder.fx) > 1e-6 * cylinder.fx:
        raise LandmarkNavError(
            f'panorama of {cylinder.width} columns has {k[0]:g} px/rad: it must span one turn '
            f'({cylinder.fx:g} px/rad)'
        )
    pixels = image_bgra(image_msg)
    if pixels.shape[:2] != (cylinder.height, cylinder.width):
        raise LandmarkNavError(
            f'panorama image is {pixels.shape[1]} x {pixels.shape[0]}, its geometry '
            f'{cylinder.width} x {cylinder.height}'
        )
    pose = pose_msg.pose.pose
    position = (pose.position.x, pose.position.y, pose.position.z)
    return Panorama(
        stamp,
        np.ascontiguousarray(pixels[..., :3]),
        pixels[..., 3] > 0,
        cylinder,
        finite(position, 'panorama position', stamp, FARTHEST_M),
        yaw_rad(pose.orientation, 'panorama orientation', stamp),
        pose_covariance(pose_msg, UPRIGHT, 'panorama', stamp),
    )
