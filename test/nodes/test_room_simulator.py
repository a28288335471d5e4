"""The simulated robot survives invalid commands and changes of the system time."""

from __future__ import annotations

import math
from pathlib import Path
import time
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from graph import Graph

from landmark_nav.messages.decode import stamp_ns
from landmark_nav.nodes.room_simulator import RoomSimulatorNode
from landmark_nav.ros.topics import ros_factory
from landmark_nav.simulation.furnishing import generate_scene
from landmark_nav.storage.setup_files import load_camera

CAMERA = Path(__file__).resolve().parents[1] / 'setups' / 'camera_quarter_vga.yaml'


@pytest.fixture
def robot(graph: Graph) -> RoomSimulatorNode:
    return graph.make(RoomSimulatorNode, camera_file=str(CAMERA))


def command(robot: RoomSimulatorNode, topic: str, message: Any) -> str:
    """Hand over a message; what the robot then says of itself."""
    for subscription in robot.subscriptions:
        if subscription.topic_name == f'/{topic}':
            subscription.callback(message, {})
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


def test_commands_that_are_not_finite_are_dropped_and_reported(robot: RoomSimulatorNode) -> None:
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


def test_the_room_and_camera_are_those_of_simulate(graph: Graph) -> None:
    node = graph.make(RoomSimulatorNode, seed=7, camera_file=str(CAMERA))
    # So a map that was learned of what `simulate` writes is valid here.
    assert node._world.scene == generate_scene(7)
    assert node._world.camera == load_camera(CAMERA)
    assert node._world.camera_frame().image.shape == (240, 320, 3)


class Clocks:
    """Of the system and of the wall, as somebody sets them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.system_s, self.wall_s = 5000.0, 10.0
        monkeypatch.setattr(time, 'time_ns', lambda: round(1e9 * self.system_s))
        monkeypatch.setattr(time, 'monotonic', lambda: self.wall_s)

    def pass_by(self, seconds: float) -> None:
        self.system_s += seconds
        self.wall_s += seconds


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    return Clocks(monkeypatch)


@pytest.fixture
def stamps(
    clocks: Clocks, robot: RoomSimulatorNode, monkeypatch: pytest.MonkeyPatch
) -> dict[str, list[float]]:
    """Of joint states and images, s."""
    reported: dict[str, list[float]] = {'joints': [], 'images': []}

    def keep(name: str) -> Any:
        return lambda message: reported[name].append(1e-9 * stamp_ns(message.header))

    monkeypatch.setattr(robot._joints, 'publish', keep('joints'))
    monkeypatch.setattr(robot._info, 'publish', keep('images'))
    return reported


@pytest.mark.parametrize('set_by_s', [3600.0, 5.0, -5.0, -3600.0])
def test_stamps_follow_a_system_time_that_is_set(
    set_by_s: float, clocks: Clocks, robot: RoomSimulatorNode, stamps: dict[str, list[float]]
) -> None:
    for _ in range(2):
        clocks.pass_by(1.0)
        robot._tick()
    assert stamps['joints'][-1] == pytest.approx(5002.0, abs=0.02)
    clocks.system_s += set_by_s
    for reported in stamps.values():
        reported.clear()
    clocks.pass_by(1.0)
    robot._tick()
    for reported in stamps.values():
        assert reported[-1] == pytest.approx(5003.0 + set_by_s, abs=0.02)
    assert len(stamps['joints']) == 60


def test_a_slow_machine_is_late_until_it_catches_up_or_leaves_time_out(
    clocks: Clocks, robot: RoomSimulatorNode, stamps: dict[str, list[float]]
) -> None:
    for seconds in (1.0, 5.0):
        clocks.pass_by(seconds)
        robot._tick()
    np.testing.assert_allclose(np.diff(stamps['joints']), 1.0 / 60.0, rtol=1e-4)
    clocks.pass_by(30.0)
    robot._tick()
    clocks.pass_by(0.1)
    robot._tick()
    assert stamps['joints'][-1] == pytest.approx(5036.1, abs=0.02)
