"""Triplets and detections."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.messages.clouds import pack_cloud
from landmark_nav.messages.encode.headers import header
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.messages.layouts import DETECTIONS, TRIPLET
from landmark_nav.types import Detections, Triplet

__all__ = ['detections', 'triplet']


def detections(factory: MessageFactory, found: Detections, frame_id: str = 'base_link') -> Any:
    """
    Build the PointCloud2 of ``detections``, stamped with the image.

    What was looked for and not found follows as invalid points: NaN, with a score of 0.
    """
    points = np.zeros(len(found) + len(found.missed), dtype=DETECTIONS.fields)
    points['id'] = np.concatenate([found.ids, found.missed])
    for name in ('bearing', 'bearing_variance', 'u', 'v'):
        points[name] = np.nan
    seen = points[: len(found)]
    seen['bearing'] = found.bearing_rad
    seen['bearing_variance'] = found.variance_rad2
    seen['score'] = found.score
    seen['u'], seen['v'] = found.uv_px[:, 0], found.uv_px[:, 1]
    if len(found.points):
        seen['point'] = found.points
        seen['point_covariance'] = found.point_covariance.reshape(-1, 4)
    if found.near is not None:
        points['near'] = found.near
    points['joint_delay'] = found.joint_delay_s
    dense = not len(found.missed)
    return pack_cloud(factory, header(factory, found.stamp_ns, frame_id), points, dense)


def triplet(factory: MessageFactory, chosen: Triplet, frame_id: str = 'base_link') -> Any:
    """Build the PointCloud2 of ``triplet``."""
    points = np.zeros(3, dtype=TRIPLET.fields)
    points['id'] = chosen.ids
    points['bearing'] = chosen.bearing_rad
    points['bearing_sigma'] = chosen.sigma_rad
    points['covariance'] = chosen.covariance.reshape(-1)
    points['pan'] = chosen.pan_rad
    return pack_cloud(factory, header(factory, chosen.stamp_ns, frame_id), points)
