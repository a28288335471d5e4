"""Timers continue if the system time is set."""

from __future__ import annotations

from collections.abc import Callable

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from graph import Graph
from rclpy.clock_type import ClockType

from landmark_nav.nodes.room_simulator import RoomSimulatorNode
from landmark_nav.nodes.triplet_selector import TripletSelectorNode
from landmark_nav.ros.node import LandmarkNode


def periods(node: LandmarkNode, kind: ClockType) -> list[float]:
    """Periods of the timers on such clocks, s."""
    return sorted(1e-9 * t.timer_period_ns for t in node.timers if t.clock.clock_type is kind)


@pytest.mark.parametrize('node', [RoomSimulatorNode, TripletSelectorNode])
def test_no_timer_runs_by_the_time_of_the_system(
    node: Callable[..., LandmarkNode], graph: Graph, setup_files: dict[str, str]
) -> None:
    started = graph.make(node, robot_file=setup_files['robot_file'])
    assert len(periods(started, ClockType.STEADY_TIME)) == len(list(started.timers)) > 1


def test_choices_keep_to_the_time_of_a_bag_and_diagnostics_do_not(
    graph: Graph, setup_files: dict[str, str]
) -> None:
    robot = setup_files['robot_file']
    selector = graph.make(TripletSelectorNode, robot_file=robot, use_sim_time=True)
    assert len(periods(selector, ClockType.ROS_TIME)) == 2
    assert periods(selector, ClockType.STEADY_TIME) == pytest.approx([1.0])
