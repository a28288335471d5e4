"""Triplets and detections."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.clouds import unpack_cloud
from landmark_nav.messages.decode.headers import finite, stamp_ns
from landmark_nav.messages.layouts import DETECTION, DETECTION_DELAYS, TRIPLET
from landmark_nav.types import Detections, Triplet

__all__ = ['detections', 'triplet']


def detections(msg: Any) -> Detections:
    """
    Landmarks found in one picture, and those missed in it, out of ``detections``.

    Raises
    ------
    LandmarkNavError
        Fields are missing, or bearings or delays are not numbers.

    """
    required = [name for name in DETECTION.names or () if name not in DETECTION_DELAYS]
    points = unpack_cloud(msg, required)
    stamp = stamp_ns(msg.header)
    known = len(points) and set(DETECTION_DELAYS) <= set(points.dtype.names or ())
    delays = points[0][list(DETECTION_DELAYS)].tolist() if known else (0.0, 0.0)
    told, measured = finite(delays, 'detections delay', stamp).tolist()
    missed = np.isnan(points['bearing']) & np.isnan(points['bearing_variance'])
    ids_missed = points['id'][missed].astype(np.int64)
    points = points[~missed]
    return Detections(
        stamp,
        points['id'].astype(np.int64),
        finite(points['bearing'], 'bearing', stamp),
        finite(points['bearing_variance'], 'bearing variance', stamp),
        points['score'].astype(np.float64),
        np.stack([points['u'], points['v']], -1).astype(np.float64),
        ids_missed,
        joint_delay_s=told,
        pan_delay_s=measured,
    )


def triplet(msg: Any) -> Triplet:
    """
    The chosen three, out of ``triplet``.

    Raises
    ------
    LandmarkNavError
        Fields are missing, not three points, or values that are not numbers.

    """
    points = unpack_cloud(msg, TRIPLET.names or ())
    if len(points) != 3:
        raise LandmarkNavError(f'triplet has {len(points)} points, not 3')
    stamp = stamp_ns(msg.header)
    return Triplet(
        stamp,
        points['id'].astype(np.int64),
        finite(points['bearing'], 'triplet bearing', stamp),
        finite(points['bearing_sigma'], 'triplet sigma', stamp),
        finite(points['covariance'][0], 'triplet covariance', stamp).reshape(3, 3),
        float(finite(points['pan'][0], 'triplet pan', stamp)),
    )
