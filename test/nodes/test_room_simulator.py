"""The simulated robot goes on through commands that make no sense."""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.context import Context

from landmark_nav.nodes.room_simulator import RoomSimulatorNode
from landmark_nav.ros.factory import ros_factory


@pytest.fixture
def robot(domain_id: int) -> Iterator[RoomSimulatorNode]:
    context = Context()
    context.init(domain_id=domain_id)
    node = RoomSimulatorNode(context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def command(robot: RoomSimulatorNode, topic: str, message: Any) -> str:
    """Hand over a message; what the robot then says of itself."""
    for subscription in robot.subscriptions:
        if subscription.topic_name == f'/{topic}':
            subscription.callback(message)
    return robot._checked_health().reason


def pan(angle_rad: float) -> Any:
    point = ros_factory('trajectory_msgs/msg/JointTrajectoryPoint', positions=[angle_rad])
    return ros_factory(
        'trajectory_msgs/msg/JointTrajectory', joint_names=['pan_joint'], points=[point]
    )


def speed(linear_m_s: float, angular_rad_s: float) -> Any:
    message = ros_factory('geometry_msgs/msg/Twist')
    message.linear.x, message.angular.z = linear_m_s, angular_rad_s
    return message


def test_commands_that_are_not_finite_are_dropped_and_told(robot: RoomSimulatorNode) -> None:
    command(robot, 'pan_tilt/command', pan(0.4))
    for number in (math.nan, math.inf, -math.inf):
        told = command(robot, 'pan_tilt/command', pan(number))
        assert 'pan_tilt/command dropped: the pan is not a finite number' in told
        for wrong in (speed(number, 0.0), speed(0.0, number)):
            assert 'a speed is not a finite number' in command(robot, 'cmd_vel', wrong)
    for _ in range(120):
        robot._step()
    world = robot._world
    assert np.isfinite(world.odometry_sample().pose_odom_base).all()
    assert world.joint_sample().pan_rad == pytest.approx(0.4, abs=0.01)
    assert world.camera_frame().image.any()
