"""A renamed topic serves those who know its former name alone, once, and names them."""

from __future__ import annotations

from collections.abc import Iterator
import time
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Int32

from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.renamed_topics import FORMER_NAMES

NEW, FORMER = 'global_localization/pose', FORMER_NAMES['global_localization/pose']


class Watched(LandmarkNode):
    def __init__(self, name: str, context: Context) -> None:
        super().__init__(name, 'test', context=context)
        self.warned: list[str] = []
        self._warn_once = self.warned.append  # type: ignore[method-assign]

    def health(self) -> Health:
        return Health(Level.OK, 'fine')


class Graph:
    """Nodes in one executor."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self.executor = SingleThreadedExecutor(context=context)

    def node(self, name: str) -> Node:
        made = Node(name, context=self.context)
        self.executor.add_node(made)
        return made

    def watched(self, name: str) -> Watched:
        made = Watched(name, self.context)
        self.executor.add_node(made)
        return made

    def publish_until(self, publisher: Any, received: list[int]) -> None:
        """Publish rising numbers until one arrives, and then three more."""
        deadline, number, left = time.monotonic() + 20.0, 0, 3
        while left:
            assert time.monotonic() < deadline, 'nothing arrives'
            number, left = number + 1, left - bool(received)
            publisher.publish(Int32(data=number))
            for _ in range(10):
                self.executor.spin_once(timeout_sec=0.02)


@pytest.fixture
def graph(domain_id: int) -> Iterator[Graph]:
    context = Context()
    context.init(domain_id=domain_id)
    made = Graph(context)
    yield made
    made.executor.shutdown()
    context.try_shutdown()


def take(received: list[int]) -> Any:
    return lambda message: received.append(message.data)


def test_who_subscribes_to_the_former_name_is_served_and_named(graph: Graph) -> None:
    sender, received = graph.watched('new'), []
    publisher = sender.create_publisher(Int32, NEW, 10)
    graph.node('old').create_subscription(Int32, FORMER, take(received), 10)
    graph.publish_until(publisher, received)
    (warning,) = set(sender.warned)
    assert '/old' in warning
    assert NEW in warning


def test_who_publishes_by_the_former_name_is_heard_and_named(graph: Graph) -> None:
    listener, received = graph.watched('new'), []
    listener.create_subscription(Int32, NEW, take(received), 10)
    publisher = graph.node('old').create_publisher(Int32, FORMER, 10)
    graph.publish_until(publisher, received)
    assert any('/old' in text and NEW in text for text in listener.warned)


def test_between_new_nodes_each_message_arrives_once(graph: Graph) -> None:
    sender, listener, received = graph.watched('sender'), graph.watched('listener'), []
    listener.create_subscription(Int32, NEW, take(received), 10)
    graph.publish_until(sender.create_publisher(Int32, NEW, 10), received)
    assert len(received) == len(set(received)) >= 2
    assert not sender.warned
    assert not [text for text in listener.warned if FORMER in text]
