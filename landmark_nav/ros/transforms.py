"""Broadcast of transforms on ``/tf`` and ``/tf_static``."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from landmark_nav.messages import encode
from landmark_nav.ros.topics import LATCHED, message_class, ros_factory


class TransformBroadcaster:
    """
    Broadcasts transforms if tf2_msgs is installed (it is not part of the ROS wheels).

    A frame has one parent and one broadcaster: fusion sends ``map`` -> ``odom``; the robot, or the
    simulation, sends ``odom`` -> ``base_link`` and the frames of the pan-tilt unit.
    """

    def __init__(self, node: Node) -> None:
        self._moving: Publisher[Any] | None = None
        self._static: Publisher[Any] | None = None
        if find_spec('tf2_msgs') is not None:
            kind = message_class('tf2_msgs/msg/TFMessage')
            # Queue lengths as in tf2.
            self._moving = node.create_publisher(kind, '/tf', 100)
            self._static = node.create_publisher(kind, '/tf_static', LATCHED)

    def send(self, stamp_ns: int, moving: Iterable[encode.Transform]) -> None:
        """Send transforms of a time."""
        if self._moving is not None:
            self._moving.publish(encode.transforms(ros_factory, stamp_ns, moving))

    def send_static(self, stamp_ns: int, fixed: Iterable[encode.Transform]) -> None:
        """Send static transforms."""
        if self._static is not None:
            self._static.publish(encode.transforms(ros_factory, stamp_ns, fixed))
