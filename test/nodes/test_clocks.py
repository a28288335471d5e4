"""Timers continue if the system time is set."""

import pytest
from rclpy.clock_type import ClockType

from landmark_nav.nodes.room_simulator import RoomSimulatorNode
from landmark_nav.nodes.triplet_selector import TripletSelectorNode


def periods(node, kind):
    """Periods of the timers on such clocks, s."""
    return sorted(1e-9 * t.timer_period_ns for t in node.timers if t.clock.clock_type is kind)


@pytest.mark.parametrize('node', [RoomSimulatorNode, TripletSelectorNode])
def test_no_timer_runs_by_the_time_of_the_system(node, graph, setup_files):
    started = graph.make(node, robot_file=setup_files['robot_file'])
    assert len(periods(started, ClockType.STEADY_TIME)) == len(list(started.timers)) > 1


def test_choices_keep_to_the_time_of_a_bag_and_diagnostics_do_not(graph, setup_files):
    robot = setup_files['robot_file']
    selector = graph.make(TripletSelectorNode, robot_file=robot, use_sim_time=True)
    assert len(periods(selector, ClockType.ROS_TIME)) == 2
    assert periods(selector, ClockType.STEADY_TIME) == pytest.approx([1.0])
