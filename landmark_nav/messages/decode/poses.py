"""Odometry, poses in the plane, and places that were found."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages.clouds import unpack_cloud
from landmark_nav.messages.decode.headers import (
    covariances,
    finite,
    landmark_ids,
    seconds,
    stamp_ns,
    yaw_rad,
)
from landmark_nav.messages.global_pose import GlobalPose
from landmark_nav.messages.layouts import EXPECTATION, GLOBAL_POSE, PLANAR
from landmark_nav.types import Expectation, FloatArray, OdometrySample, PoseEstimate

__all__ = [
    'FARTHEST_M',
    'expectation',
    'global_pose',
    'odometry',
    'pose_covariance',
    'pose_estimate',
]

# Half around the earth, m: in UTM coordinates, too, a robot is nearer to their origin.
FARTHEST_M = 2.0e7
# Metres or radians per second.
_FASTEST = 1.0e3
# Beyond this, metres, radians or seconds, is no value or sigma of a calibration.
_MOST_OFF = 100.0


def odometry(msg: Any) -> OdometrySample:
    """
    Wheel odometry of a nav_msgs/Odometry.

    Raises
    ------
    LandmarkNavError
        A value is not a number, or no place, heading or speed of a robot.

    """
    stamp, twist = stamp_ns(msg.header), msg.twist.twist
    speeds = [twist.linear.x, twist.angular.z]
    forward, turn = finite(speeds, 'odometry speed', stamp, _FASTEST).tolist()
    return OdometrySample(stamp, _planar(msg.pose.pose, 'odometry', stamp), forward, turn)


def pose_estimate(msg: Any) -> PoseEstimate:
    """
    Planar pose of a geometry_msgs/PoseWithCovarianceStamped or a nav_msgs/Odometry.

    Raises
    ------
    LandmarkNavError
        A value is not a number, or no place or heading of a robot.

    """
    stamp = stamp_ns(msg.header)
    pose = _planar(msg.pose.pose, 'pose', stamp)
    return PoseEstimate(stamp, pose, pose_covariance(msg, PLANAR, 'pose', stamp))


def pose_covariance(msg: Any, axes: tuple[Any, ...], what: str, stamp: int) -> FloatArray:
    """
    Covariance of some axes, a layout, out of a message with a geometry_msgs/PoseWithCovariance.

    Of the others anything may be given: 0, 1e6 and the largest number all stand for "unknown".
    """
    what = f'{what} covariance'
    full = finite(msg.pose.covariance, what, stamp, np.inf, count=36)
    (covariance,) = covariances(full.reshape(6, 6)[axes], what, stamp, len(axes[0]))
    return np.asarray(covariance)


def global_pose(msg: Any) -> GlobalPose:
    """
    A place and what it was found from, out of ``global_localization/pose``.

    Raises
    ------
    LandmarkNavError
        Fields are missing or of another kind, no point, or values that are not numbers.

    """
    points, stamp = unpack_cloud(msg, GLOBAL_POSE), stamp_ns(msg.header)
    if not len(points):
        raise LandmarkNavError(
            f'global_localization/pose at {stamp * 1e-9:.3f} s names no landmark'
        )
    first = points[0]
    return GlobalPose(
        stamp,
        finite(first['pose'], 'global_localization/pose pose', stamp, FARTHEST_M),
        covariances(first['covariance'], 'global_localization/pose covariance', stamp, 3)[0],
        landmark_ids(points['id'], 'global_localization/pose'),
        float(finite(first['pan_rate'], 'global_localization/pose pan rate', stamp, _FASTEST)),
        *seconds([first['joint_delay']], 'global_localization/pose delay', stamp),
    )


def expectation(msg: Any, mount: PanTiltMount) -> tuple[Expectation, OdometrySample]:
    """
    Where the camera should be, and the speeds of the base, out of ``expectation``.

    Raises
    ------
    LandmarkNavError
        Fields are missing or of another kind, not one point, or values that are not numbers.

    """
    points, stamp = unpack_cloud(msg, EXPECTATION), stamp_ns(msg.header)
    if len(points) != 1:
        raise LandmarkNavError(f'expectation has {len(points)} points, not 1')
    first = points[0]
    pose = finite(first['pose'], 'expectation pose', stamp, FARTHEST_M)
    sigmas = finite(first['sigmas'], 'calibration sigma', stamp, _MOST_OFF, least=0.0)
    linear, angular = finite(first['speeds'], 'expectation speed', stamp, _FASTEST).tolist()
    expected = Expectation(
        stamp,
        pose,
        covariances(first['covariance'], 'expectation covariance', stamp, 3)[0],
        Calibration(
            finite(first['values'], 'calibration value', stamp, _MOST_OFF),
            np.diag(sigmas**2),
            mount,
        ),
        float(finite(first['tilt_sigma'], 'tilt sigma', stamp, _MOST_OFF, least=0.0)),
    )
    return expected, OdometrySample(stamp, pose, linear, angular)


def _planar(pose: Any, what: str, stamp: int) -> FloatArray:
    position = finite([pose.position.x, pose.position.y], f'{what} position', stamp, FARTHEST_M)
    return np.array([*position, yaw_rad(pose.orientation, f'{what} orientation', stamp)])
