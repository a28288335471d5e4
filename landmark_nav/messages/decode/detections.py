"""Triplets and detections."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.clouds import unpack_cloud
from landmark_nav.messages.decode.headers import (
    covariances,
    finite,
    landmark_ids,
    seconds,
    stamp_ns,
)
from landmark_nav.messages.decode.poses import FARTHEST_M
from landmark_nav.messages.layouts import DETECTIONS, TRIPLET
from landmark_nav.types import Detections, Triplet

__all__ = ['detections', 'triplet']

# Bearings may be unwrapped. No sensor is as exact as the root of this, rad.
_MOST_RAD, _LEAST_VARIANCE = 1e4, 1e-14
# Nothing is seen 89.9 degrees aside.
_FARTHEST = 1e3


def detections(msg: Any) -> Detections:
    """
    Landmarks found in one image, and those missed in it, out of ``detections``.

    Raises
    ------
    LandmarkNavError
        Fields are missing or of another kind, or values are not numbers within bounds.

    """
    points, stamp = unpack_cloud(msg, DETECTIONS), stamp_ns(msg.header)
    (delay,) = seconds(points['joint_delay'][:1].tolist() or [0.0], 'detections delay', stamp)
    # Other sensors may see a landmark twice at a time.
    landmark_ids(points['id'], 'detections', unique=False)
    missed = np.isnan(points['bearing']) & np.isnan(points['bearing_variance'])
    found = points[~missed]
    spread = covariances(found['point_covariance'], 'covariance of a point', stamp, 2)
    # Who measures bearings alone has no image.
    of_image = bool((np.diagonal(spread, axis1=1, axis2=2) > 0.0).all())
    places = finite(found['point'], 'detections point', stamp, _FARTHEST)
    near = finite(points['near'][0] if len(points) else np.zeros(3), 'near', stamp, FARTHEST_M)
    return Detections(
        stamp,
        found['id'],
        finite(found['bearing'], 'bearing', stamp, _MOST_RAD),
        finite(found['bearing_variance'], 'bearing variance', stamp, least=_LEAST_VARIANCE),
        finite(found['score'], 'detections score', stamp),
        finite(np.stack([found['u'], found['v']], -1), 'detections pixel', stamp),
        points['id'][missed],
        joint_delay_s=delay,
        points=places if of_image else places[:0],
        point_covariance=spread if of_image else spread[:0],
        near=near if near.any() else None,
    )


def triplet(msg: Any) -> Triplet:
    """
    The chosen three, out of ``triplet``.

    Raises
    ------
    LandmarkNavError
        Fields are missing or of another kind, not three points, or values that are not numbers.

    """
    points, stamp = unpack_cloud(msg, TRIPLET), stamp_ns(msg.header)
    if len(points) != 3:
        raise LandmarkNavError(f'triplet has {len(points)} points, not 3')
    return Triplet(
        stamp,
        landmark_ids(points['id'], 'triplet'),
        finite(points['bearing'], 'triplet bearing', stamp, _MOST_RAD),
        finite(points['bearing_sigma'], 'triplet sigma', stamp, least=0.0),
        covariances(points['covariance'][0], 'triplet covariance', stamp, 3)[0],
        float(finite(points['pan'][0], 'triplet pan', stamp, _MOST_RAD)),
    )
