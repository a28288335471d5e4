"""Odometry, poses in the plane, and places that were found."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.clouds import unpack_cloud
from landmark_nav.messages.decode.headers import finite, stamp_ns, yaw_rad
from landmark_nav.messages.found_place import FoundPlace
from landmark_nav.messages.layouts import FOUND_PLACE, PLANAR
from landmark_nav.types import FloatArray, OdometrySample, PoseEstimate

__all__ = ['found_place', 'odometry', 'pose_estimate']

# Half around the earth: in UTM coordinates, too, a robot is nearer to their origin.
_FARTHEST_M = 2.0e7
# Metres or radians per second.
_FASTEST = 1.0e3


def odometry(msg: Any) -> OdometrySample:
    """
    Wheel odometry of a nav_msgs/Odometry.

    Raises
    ------
    LandmarkNavError
        A value is not a number, or no place, heading or speed of a robot.

    """
    stamp = stamp_ns(msg.header)
    twist = msg.twist.twist
    speeds = finite([twist.linear.x, twist.angular.z], 'odometry speed', stamp)
    if np.abs(speeds).max() > _FASTEST:
        raise LandmarkNavError(
            f'odometry speed at {stamp * 1e-9:.3f} s is {np.array2string(speeds, precision=3)} '
            'm/s, rad/s: no robot is as fast, mend its publisher'
        )
    return OdometrySample(
        stamp, _planar(msg.pose.pose, 'odometry', stamp), float(speeds[0]), float(speeds[1])
    )


def pose_estimate(msg: Any) -> PoseEstimate:
    """
    Planar pose of a geometry_msgs/PoseWithCovarianceStamped or a nav_msgs/Odometry.

    Raises
    ------
    LandmarkNavError
        A value is not a number, or no place or heading of a robot.

    """
    stamp = stamp_ns(msg.header)
    full = finite(msg.pose.covariance, 'pose covariance', stamp).reshape(6, 6)
    return PoseEstimate(stamp, _planar(msg.pose.pose, 'pose', stamp), full[PLANAR])


def found_place(msg: Any) -> FoundPlace:
    """
    A place and what it was found from, out of ``found_place``.

    Raises
    ------
    LandmarkNavError
        Fields are missing or of another size, no point, or values that are not numbers.

    """
    points = unpack_cloud(msg, FOUND_PLACE.names or ())
    stamp = stamp_ns(msg.header)
    if not len(points):
        raise LandmarkNavError(f'found_place at {stamp * 1e-9:.3f} s names no landmark')
    first = points[0]
    if np.shape(first['pose']) != (3,) or np.shape(first['covariance']) != (9,):
        raise LandmarkNavError(
            f'found_place at {stamp * 1e-9:.3f} s has no pose of 3 and covariance of 9 numbers'
        )
    covariance = finite(first['covariance'], 'found_place covariance', stamp).reshape(3, 3)
    pan = [first[name] for name in ('pan_rate', 'joint_delay', 'pan_delay')]
    return FoundPlace(
        stamp,
        finite(first['pose'], 'found_place pose', stamp),
        covariance,
        points['id'].astype(np.int64),
        *finite(pan, 'found_place pan', stamp).tolist(),
    )


def _planar(pose: Any, what: str, stamp: int) -> FloatArray:
    position = finite([pose.position.x, pose.position.y], f'{what} position', stamp)
    if np.abs(position).max() > _FARTHEST_M:
        raise LandmarkNavError(
            f'{what} position at {stamp * 1e-9:.3f} s is {np.array2string(position, precision=3)} '
            'm: not on this planet, mend its publisher'
        )
    return np.array([*position, yaw_rad(pose.orientation, f'{what} orientation', stamp)])
