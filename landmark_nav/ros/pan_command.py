"""``pan_tilt/command`` in the message type of the robot's controller."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from typing import Any

from builtin_interfaces.msg import Duration
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.topics import RELIABLE

_TOPIC = 'pan_tilt/command'
_CLASSES: dict[str, Any] = {
    'JointTrajectory': JointTrajectory,
    'JointState': JointState,
    'Float64MultiArray': Float64MultiArray,
}
# Smallest duration of a move: controllers refuse a duration of 0.
_MIN_DURATION_S = 0.1


class PanCommander:
    """Publishes pan commands; if `with_tilt`, the tilt joint is commanded too, to 0."""

    def __init__(
        self, node: LandmarkNode, mount: PanTiltMount, kind: str, with_tilt: bool = False
    ) -> None:
        self._node, self._kind, self._rate_rad_s = node, kind, mount.pan_rate_rad_s
        self._joints = [mount.pan_joint, *([mount.tilt_joint] if with_tilt else [])]
        self._publisher = node.create_publisher(_CLASSES[kind], _TOPIC, RELIABLE)

    def command(self, pan_rad: float, from_pan_rad: float | None = None) -> None:
        """Turn to `pan_rad`; `from_pan_rad`, if known, determines the duration of the move."""
        positions = [pan_rad, 0.0][: len(self._joints)]
        stamp = self._node.get_clock().now().to_msg()
        if self._kind == 'Float64MultiArray':
            message: Any = Float64MultiArray(data=positions)
        elif self._kind == 'JointState':
            message = JointState(name=self._joints, position=positions)
            message.header.stamp = stamp
        else:
            way = abs(pan_rad - from_pan_rad) if from_pan_rad is not None else 0.0
            seconds = max(way / self._rate_rad_s, _MIN_DURATION_S)
            point = JointTrajectoryPoint(
                positions=positions,
                time_from_start=Duration(sec=int(seconds), nanosec=int(seconds % 1.0 * 1e9)),
            )
            # A stamp of zero means: start on arrival.
            message = JointTrajectory(joint_names=self._joints, points=[point])
        self._publisher.publish(message)


def listen_for_pan(
    node: LandmarkNode, mount: PanTiltMount, kind: str, callback: Callable[[float], None]
) -> Subscription[Any]:
    """Call back with the pan of every command."""

    def take(message: Any) -> None:
        if kind == 'Float64MultiArray':
            names, positions = [mount.pan_joint], message.data
        elif kind == 'JointState':
            names, positions = list(message.name), message.position
        else:
            names = list(message.joint_names)
            positions = message.points[-1].positions if message.points else []
        if mount.pan_joint in names and names.index(mount.pan_joint) < len(positions):
            pan_rad = float(positions[names.index(mount.pan_joint)])
            if not isfinite(pan_rad):
                raise LandmarkNavError('the pan is not a finite number')
            callback(pan_rad)

    return node.create_subscription(_CLASSES[kind], _TOPIC, take, RELIABLE)
