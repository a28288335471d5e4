"""Factories of messages (those of ROS classes are in `landmark_nav.ros`), and common parts."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

from landmark_nav.types import FloatArray


class MessageFactory(Protocol):
    """
    Builds a message by its type name, such as ``geometry_msgs/msg/Pose``.

    Omitted fields have the defaults of ROS. Numeric arrays are one-dimensional NumPy arrays of the
    field's element type, whether their length is fixed or not. A factory for classes that need
    another type converts them (``array.array`` for ``uint8[]``: rclpy checks every element of
    other types).
    """

    def __call__(self, type_name: str, **fields: Any) -> Any:
        """Return the message."""


def default_typestore() -> Typestore:
    """Return the standard message types that this package reads and writes."""
    return get_typestore(Stores.ROS2_JAZZY)


def rosbag_factory() -> MessageFactory:
    """Return a factory of messages that rosbags serialises."""
    store = default_typestore()

    def build(type_name: str, **fields: Any) -> Any:
        _, definitions = store.fielddefs[type_name]
        unknown = fields.keys() - {name for name, _ in definitions}
        if unknown:
            raise TypeError(f'{type_name} has no field {", ".join(sorted(unknown))}')
        for name, description in definitions:
            if name not in fields:
                fields[name] = default(description)
        if type_name == 'geometry_msgs/msg/Quaternion' and not any(fields.values()):
            fields['w'] = 1.0
        return store.types[type_name](**fields)

    def default(description: Any) -> Any:
        kind, content = description
        if kind == Nodetype.NAME:
            return build(content)
        if kind == Nodetype.BASE:
            return '' if content[0] == 'string' else _scalar_type(content[0])().item()
        element, length = content
        if element[0] == Nodetype.BASE and element[1][0] != 'string':
            count = length if kind == Nodetype.ARRAY else 0
            return np.zeros(count, dtype=_scalar_type(element[1][0]))
        return [default(element) for _ in range(length if kind == Nodetype.ARRAY else 0)]

    return build


def _scalar_type(name: str) -> Any:
    return {'bool': np.bool_, 'byte': np.uint8, 'char': np.uint8}.get(name) or getattr(np, name)


# Indices of (x, y, heading) and (x, y, z, heading) in ROS' covariance of (x, y, z, roll, pitch,
# yaw).
PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
UPRIGHT = np.ix_([0, 1, 2, 5], [0, 1, 2, 5])
# Variance of what is not estimated, as in robot_localization and others: 0 would mean exact.
UNKNOWN_VARIANCE = 1e6


def time_message(factory: MessageFactory, time_ns: int, kind: str = 'Time') -> Any:
    """Build a builtin_interfaces message `kind` (Time, Duration)."""
    sec, nanosec = divmod(time_ns, 10**9)
    return factory(f'builtin_interfaces/msg/{kind}', sec=sec, nanosec=nanosec)


def header(factory: MessageFactory, stamp_ns: int, frame_id: str) -> Any:
    """Build a std_msgs/Header."""
    stamp = time_message(factory, stamp_ns)
    return factory('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)


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
