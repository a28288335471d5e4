"""State of a node for ``/diagnostics``: OK, degraded or lost, with the reason; clocks, latency."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node


def steady_clock() -> Clock:
    """A monotonic clock, independent of the system time and of the clock of a bag."""
    return Clock(clock_type=ClockType.STEADY_TIME)


def own_clock(node: Node) -> Clock:
    """``/clock`` with `use_sim_time` (a bag may run at another rate), else the steady clock."""
    return node.get_clock() if node.get_parameter('use_sim_time').value else steady_clock()


class Level(Enum):
    """State of a node."""

    OK = DiagnosticStatus.OK
    DEGRADED = DiagnosticStatus.WARN
    LOST = DiagnosticStatus.ERROR


@dataclass(frozen=True)
class Health:
    """State of a node, its reason, and further values."""

    level: Level
    reason: str
    values: Mapping[str, object] = field(default_factory=dict)


# Number of recent latencies: some seconds of images.
_KEPT = 100
# Beyond this, the stamps are of another clock, such as that of a bag.
_OTHER_CLOCK_NS = 10**10


class Latency:
    """Latencies of the recent results: time from the stamp of an image until its use."""

    def __init__(self) -> None:
        self._ages_ns: deque[int] = deque(maxlen=_KEPT)

    def note(self, age_ns: int) -> None:
        """Add a latency; it is ignored if the clocks differ."""
        if abs(age_ns) < _OTHER_CLOCK_NS:
            self._ages_ns.append(age_ns)

    def values(self) -> dict[str, object]:
        """Median and 95th percentile, for the values of diagnostics."""
        if not self._ages_ns:
            return {}
        ages_ms = 1e-6 * np.array(self._ages_ns)
        return {
            'latency_median_ms': f'{np.median(ages_ms):.0f}',
            'latency_p95_ms': f'{np.percentile(ages_ms, 95):.0f}',
        }
