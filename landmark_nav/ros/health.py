"""``/diagnostics`` once a second: OK, degraded or lost, with the reason."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from landmark_nav.ros.clocks import steady_clock
from landmark_nav.ros.topics import TOPICS


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


def publish_health(node: Node, subcomponent: str, report: Callable[[], Health]) -> None:
    """Publish `report()` once a second by the steady clock, even if ``/clock`` has stopped."""
    topic = '/diagnostics'
    publisher = node.create_publisher(DiagnosticArray, topic, TOPICS[topic].qos)

    def publish() -> None:
        health = report()
        status = DiagnosticStatus(
            level=health.level.value,
            name=f'{node.get_name()}: {subcomponent}',
            message=health.reason,
            hardware_id=node.get_fully_qualified_name(),
            values=[
                KeyValue(key=key, value=f'{value:.6g}' if isinstance(value, float) else str(value))
                for key, value in health.values.items()
            ],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(array)

    # Not `LandmarkNode.create_timer`: diagnostics are published in every lifecycle state.
    Node.create_timer(
        node,
        1.0,
        publish,
        callback_group=ReentrantCallbackGroup(),
        clock=steady_clock(),
    )
