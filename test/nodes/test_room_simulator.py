"""The simulated robot survives invalid commands and changes of the system time."""

import math
import time

from harness import SETUPS
import numpy as np
import pytest

from landmark_nav.messages.decode import stamp_ns
from landmark_nav.nodes.room_simulator import RoomSimulatorNode
from landmark_nav.ros.topics import ros_factory


@pytest.fixture
def robot(graph):
    return graph.make(RoomSimulatorNode, camera_file=str(SETUPS / 'camera_quarter_vga.yaml'))


def command(robot, topic, message):
    """Hand over a message; what the robot then says of itself."""
    for subscription in robot.subscriptions:
        if subscription.topic_name == f'/{topic}':
            subscription.callback(message, {})
    return robot._checked_health().reason


def pan(angle_rad):
    point = ros_factory('trajectory_msgs/msg/JointTrajectoryPoint', positions=[angle_rad])
    return ros_factory(
        'trajectory_msgs/msg/JointTrajectory', joint_names=['pan_joint'], points=[point]
    )


def speed(linear_m_s, angular_rad_s):
    message = ros_factory('geometry_msgs/msg/Twist')
    message.linear.x, message.angular.z = linear_m_s, angular_rad_s
    return message


def test_commands_that_are_not_finite_are_dropped_and_reported(robot):
    command(robot, 'pan_tilt/command', pan(0.4))
    for number in (math.nan, math.inf, -math.inf):
        reported = command(robot, 'pan_tilt/command', pan(number))
        assert 'pan_tilt/command dropped: the pan is not a finite number' in reported
        for wrong in (speed(number, 0.0), speed(0.0, number)):
            assert 'a speed is not a finite number' in command(robot, 'cmd_vel', wrong)
    for _ in range(120):
        robot._step()
    world = robot._world
    assert np.isfinite(world.odometry_sample().pose_odom_base).all()
    assert world.joint_sample().pan_rad == pytest.approx(0.4, abs=0.01)
    assert world.camera_frame().image.any()


class Clocks:
    """Of the system and of the wall, as somebody sets them."""

    def __init__(self, monkeypatch):
        self.system_s, self.wall_s = 5000.0, 10.0
        monkeypatch.setattr(time, 'time_ns', lambda: round(1e9 * self.system_s))
        monkeypatch.setattr(time, 'monotonic', lambda: self.wall_s)

    def pass_by(self, seconds):
        self.system_s += seconds
        self.wall_s += seconds


@pytest.fixture
def clocks(monkeypatch):
    return Clocks(monkeypatch)


@pytest.fixture
def stamps(clocks, robot, monkeypatch):
    """Of joint states and images, s."""
    reported: dict[str, list[float]] = {'joints': [], 'images': []}

    def keep(name):
        return lambda message: reported[name].append(1e-9 * stamp_ns(message.header))

    monkeypatch.setattr(robot._joints, 'publish', keep('joints'))
    monkeypatch.setattr(robot._info, 'publish', keep('images'))
    return reported


def test_stamps_follow_a_system_time_that_is_set(clocks, robot, stamps):
    for _ in range(2):
        clocks.pass_by(1.0)
        robot._tick()
    assert stamps['joints'][-1] == pytest.approx(5002.0, abs=0.02)
    for set_by_s in (3600.0, 5.0, -5.0, -3600.0):
        clocks.system_s += set_by_s
        for reported in stamps.values():
            reported.clear()
        clocks.pass_by(1.0)
        robot._tick()
        for reported in stamps.values():
            assert reported[-1] == pytest.approx(clocks.system_s, abs=0.02)
        assert len(stamps['joints']) == 60
