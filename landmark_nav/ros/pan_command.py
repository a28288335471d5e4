"""``pan_tilt/command`` in the message type that the robot's controller takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from typing import Any

from builtin_interfaces.msg import Duration
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.parameters import Config, parameter
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.topics import RELIABLE

__all__ = ['COMMAND_TYPES', 'PanCommandParameters', 'PanCommander', 'listen_for_pan']

_TOPIC = 'pan_tilt/command'
_CLASSES: dict[str, Any] = {
    'JointTrajectory': JointTrajectory,
    'JointState': JointState,
    'Float64MultiArray': Float64MultiArray,
}
COMMAND_TYPES = tuple(_CLASSES)


@dataclass(frozen=True)
class PanCommandParameters(Config):
    """How the pan-tilt unit is commanded."""

    type: str = parameter(
        'JointTrajectory', 'message type of pan_tilt/command', choices=COMMAND_TYPES
    )
    with_tilt: bool = parameter(False, 'command the tilt joint too, to stay level')
    speed_rad_s: float = parameter(
        1.0, 'pan rate that a JointTrajectory plans with, rad/s', minimum=0.01
    )
    min_duration_s: float = parameter(
        0.1, 'least time that a JointTrajectory gives a move, s', minimum=0.0
    )


class PanCommander:
    """Publishes where the camera should look."""

    def __init__(
        self, node: LandmarkNode, mount: PanTiltMount, parameters: PanCommandParameters
    ) -> None:
        self._node = node
        self._joints = [mount.pan_joint, *([mount.tilt_joint] if parameters.with_tilt else [])]
        self._parameters = parameters
        self._publisher = node.create_publisher(_CLASSES[parameters.type], _TOPIC, RELIABLE)

    def command(self, pan_rad: float, from_pan_rad: float | None = None) -> None:
        """Turn to `pan_rad`; `from_pan_rad`, where known, sets the duration of the move."""
        positions = [pan_rad, 0.0][: len(self._joints)]
        stamp = self._node.get_clock().now().to_msg()
        if self._parameters.type == 'Float64MultiArray':
            message: Any = Float64MultiArray(data=positions)
        elif self._parameters.type == 'JointState':
            message = JointState(name=self._joints, position=positions)
            message.header.stamp = stamp
        else:
            way = abs(pan_rad - from_pan_rad) if from_pan_rad is not None else 0.0
            seconds = max(way / self._parameters.speed_rad_s, self._parameters.min_duration_s)
            point = JointTrajectoryPoint(
                positions=positions,
                time_from_start=Duration(sec=int(seconds), nanosec=int(seconds % 1.0 * 1e9)),
            )
            # A stamp of zero means: start now, whatever the delay on the way.
            message = JointTrajectory(joint_names=self._joints, points=[point])
        self._publisher.publish(message)


def listen_for_pan(
    node: LandmarkNode, mount: PanTiltMount, kind: str, callback: Callable[[float], None]
) -> Subscription[Any]:
    """Call back with the pan of every command that somebody gives."""

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
