"""Parts of many messages: headers, durations, vectors and poses."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.messages.factory import MessageFactory
from landmark_nav.types import FloatArray

_SECOND_NS = 1_000_000_000
# Variance of what is not estimated, as in robot_localization and others: 0 would mean exact.
UNKNOWN_VARIANCE = 1e6


def header(factory: MessageFactory, stamp_ns: int, frame_id: str) -> Any:
    """Build a std_msgs/Header."""
    sec, nanosec = divmod(stamp_ns, _SECOND_NS)
    stamp = factory('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
    return factory('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)


def duration(factory: MessageFactory, span_ns: int) -> Any:
    """Build a builtin_interfaces/Duration."""
    sec, nanosec = divmod(span_ns, _SECOND_NS)
    return factory('builtin_interfaces/msg/Duration', sec=sec, nanosec=nanosec)


def vector(factory: MessageFactory, kind: str, x: float, y: float, z: float = 0.0) -> Any:
    """Build a geometry_msgs message `kind` (Point, Vector3) of x, y, z."""
    return factory(f'geometry_msgs/msg/{kind}', x=float(x), y=float(y), z=float(z))


def upright(factory: MessageFactory, x: float, y: float, z: float, yaw_rad: float) -> Any:
    """Build a geometry_msgs/Pose with a rotation about z only."""
    half = 0.5 * float(yaw_rad)
    turn = factory('geometry_msgs/msg/Quaternion', z=float(np.sin(half)), w=float(np.cos(half)))
    return factory(
        'geometry_msgs/msg/Pose', position=vector(factory, 'Point', x, y, z), orientation=turn
    )


def pose_with_covariance(
    factory: MessageFactory,
    x_y_z_yaw: tuple[float, float, float, float],
    covariance: FloatArray,
    axes: tuple[Any, ...],
) -> Any:
    """
    Build a geometry_msgs/PoseWithCovariance.

    `axes` are those of `covariance` (`PLANAR`, `UPRIGHT`); the others are unknown.
    """
    full = UNKNOWN_VARIANCE * np.eye(6)
    full[axes] = covariance
    return factory(
        'geometry_msgs/msg/PoseWithCovariance',
        pose=upright(factory, *x_y_z_yaw),
        covariance=full.reshape(-1),
    )
