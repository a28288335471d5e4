"""The one transform this package owns, ``map`` -> ``odom``."""

from __future__ import annotations

from importlib.util import find_spec

from rclpy.node import Node

from landmark_nav.messages.encode.transforms import planar_transform, transforms
from landmark_nav.ros.factory import message_class, ros_factory
from landmark_nav.types import FloatArray

__all__ = ['MapToOdom']


class MapToOdom:
    """
    Broadcasts ``map`` -> ``odom``, if tf2_msgs is installed (the ROS wheels have none).

    Who publishes ``odom`` -> ``base_link`` is the robot: a frame has one parent only.
    """

    def __init__(self, node: Node) -> None:
        self._publisher = None
        if find_spec('tf2_msgs') is not None:
            # The depth that tf2's own broadcaster has.
            kind = message_class('tf2_msgs/msg/TFMessage')
            self._publisher = node.create_publisher(kind, '/tf', 100)

    def send(self, stamp_ns: int, pose_map_odom: FloatArray, frames: tuple[str, str]) -> None:
        """Send a transform between these two frames."""
        if self._publisher is not None:
            sent = [planar_transform(*frames, pose_map_odom)]
            self._publisher.publish(transforms(ros_factory, stamp_ns, sent))
