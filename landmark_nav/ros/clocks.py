"""Clocks for timers, which fall silent for as long as their clock is set back."""

from __future__ import annotations

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node


def steady_clock() -> Clock:
    """The wall's time, which goes on as the system's is set, and while a bag's stands."""
    return Clock(clock_type=ClockType.STEADY_TIME)


def own_clock(node: Node) -> Clock:
    """``/clock`` with `use_sim_time`, where a bag may be faster than the wall; else steady."""
    return node.get_clock() if node.get_parameter('use_sim_time').value else steady_clock()
