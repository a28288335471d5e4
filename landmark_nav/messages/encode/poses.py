"""Odometry, poses in the plane, and places that were found."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.messages.clouds import pack_cloud
from landmark_nav.messages.encode.headers import (
    header,
    pose_with_covariance,
    UNKNOWN_VARIANCE,
    upright,
    vector,
)
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.messages.global_pose import GlobalPose
from landmark_nav.messages.layouts import EXPECTATION, GLOBAL_POSE, PLANAR
from landmark_nav.types import Expectation, FloatArray, OdometrySample, PoseEstimate

__all__ = ['expectation', 'global_pose', 'odometry', 'pose', 'pose_stamped']

_UNKNOWN: FloatArray = UNKNOWN_VARIANCE * np.eye(3)


def odometry(
    factory: MessageFactory,
    sample: OdometrySample,
    covariance: FloatArray = _UNKNOWN,
    *,
    frame_id: str = 'odom',
    child_frame_id: str = 'base_link',
) -> Any:
    """
    Build a nav_msgs/Odometry.

    Parameters
    ----------
    factory : MessageFactory
        Builds the message.
    sample : OdometrySample
        Pose of the base in `frame_id`, whichever that is, and speeds.
    covariance : ndarray, shape (3, 3), optional
        Of x, y, heading; unknown by default.
    frame_id, child_frame_id : str
        Frames.

    """
    x, y, yaw = sample.pose_odom_base
    twist = factory(
        'geometry_msgs/msg/Twist',
        linear=vector(factory, 'Vector3', sample.linear_m_s, 0.0),
        angular=vector(factory, 'Vector3', 0.0, 0.0, sample.angular_rad_s),
    )
    return factory(
        'nav_msgs/msg/Odometry',
        header=header(factory, sample.stamp_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=pose_with_covariance(factory, (x, y, 0.0, yaw), covariance, PLANAR),
        twist=factory(
            'geometry_msgs/msg/TwistWithCovariance',
            twist=twist,
            covariance=UNKNOWN_VARIANCE * np.eye(6).reshape(-1),
        ),
    )


def pose(factory: MessageFactory, estimate: PoseEstimate, frame_id: str = 'map') -> Any:
    """Build a geometry_msgs/PoseWithCovarianceStamped."""
    x, y, yaw = estimate.pose
    return factory(
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        header=header(factory, estimate.stamp_ns, frame_id),
        pose=pose_with_covariance(factory, (x, y, 0.0, yaw), estimate.covariance, PLANAR),
    )


def global_pose(factory: MessageFactory, place: GlobalPose, frame_id: str = 'map') -> Any:
    """Build the PointCloud2 of ``global_localization/pose``, stamped with the image."""
    points = np.zeros(len(place.ids), dtype=GLOBAL_POSE.fields)
    points['id'] = place.ids
    points['pose'] = place.pose
    points['covariance'] = place.covariance.reshape(-1)
    points['pan_rate'] = place.pan_rate_rad_s
    points['joint_delay'] = place.joint_delay_s
    return pack_cloud(factory, header(factory, place.stamp_ns, frame_id), points)


def expectation(
    factory: MessageFactory,
    expected: Expectation,
    speeds: OdometrySample,
    frame_id: str = 'map',
) -> Any:
    """Build the PointCloud2 of ``expectation``, one point, with the speeds of its time."""
    known = expected.calibration
    point = (
        expected.pose,
        expected.covariance.reshape(-1),
        (speeds.linear_m_s, speeds.angular_rad_s),
        expected.tilt_sigma_rad,
        known.values,
        known.sigmas,
    )
    points = np.array([point], dtype=EXPECTATION.fields)
    return pack_cloud(factory, header(factory, expected.stamp_ns, frame_id), points)


def pose_stamped(
    factory: MessageFactory, stamp_ns: int, pose_map: FloatArray, frame_id: str = 'map'
) -> Any:
    """Build a geometry_msgs/PoseStamped of a planar pose (3,)."""
    x, y, yaw = pose_map
    return factory(
        'geometry_msgs/msg/PoseStamped',
        header=header(factory, stamp_ns, frame_id),
        pose=upright(factory, x, y, 0.0, yaw),
    )
