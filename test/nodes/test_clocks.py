"""What nodes do again and again goes on though somebody sets the system's time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.parameter import Parameter

from landmark_nav.nodes.room_simulator import RoomSimulatorNode
from landmark_nav.nodes.triplet_selector import TripletSelectorNode
from landmark_nav.ros.node import LandmarkNode


@pytest.fixture
def made(domain_id: int, setup_files: dict[str, str]) -> Iterator[Callable[..., LandmarkNode]]:
    context = Context()
    context.init(domain_id=domain_id)
    nodes: list[LandmarkNode] = []

    def make(kind: Callable[..., LandmarkNode], **parameters: Any) -> LandmarkNode:
        given = {'robot_file': setup_files['robot_file'], **parameters}
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        nodes.append(kind(context=context, parameter_overrides=overrides))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()


def periods(node: LandmarkNode, kind: ClockType) -> list[float]:
    """Periods of the timers on such clocks, s."""
    return sorted(1e-9 * t.timer_period_ns for t in node.timers if t.clock.clock_type is kind)


@pytest.mark.parametrize('node', [RoomSimulatorNode, TripletSelectorNode])
def test_no_timer_runs_by_the_time_of_the_system(
    node: Callable[..., LandmarkNode], made: Callable[..., LandmarkNode]
) -> None:
    started = made(node)
    assert len(periods(started, ClockType.STEADY_TIME)) == len(list(started.timers)) > 1


def test_choices_keep_to_the_time_of_a_bag_and_diagnostics_do_not(
    made: Callable[..., LandmarkNode],
) -> None:
    selector = made(TripletSelectorNode, use_sim_time=True)
    assert len(periods(selector, ClockType.ROS_TIME)) == 2
    assert periods(selector, ClockType.STEADY_TIME) == pytest.approx([1.0])


def test_the_simulated_robot_needs_no_clock_of_a_bag(made: Callable[..., LandmarkNode]) -> None:
    robot = made(RoomSimulatorNode, use_sim_time=True)
    assert len(periods(robot, ClockType.STEADY_TIME)) == 2
    assert isinstance(robot, RoomSimulatorNode)
    assert robot._world.stamp_ns > 0
