"""Clocks for timers. A timer pauses while its clock is set back."""

from __future__ import annotations

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node


def steady_clock() -> Clock:
    """A monotonic clock, independent of the system time and of the clock of a bag."""
    return Clock(clock_type=ClockType.STEADY_TIME)


def own_clock(node: Node) -> Clock:
    """``/clock`` with `use_sim_time` (a bag may run at another rate), else the steady clock."""
    return node.get_clock() if node.get_parameter('use_sim_time').value else steady_clock()
