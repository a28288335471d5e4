"""A renamed topic serves nodes that only know its former name, once, with a warning."""

from itertools import count

from rclpy.node import Node
from std_msgs.msg import Int32

from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.topics import FORMER_NAMES

NEW, FORMER = 'global_localization/pose', FORMER_NAMES['global_localization/pose']


class Watched(LandmarkNode):
    def __init__(self, name, context):
        super().__init__(name, 'test', context=context)
        self.warned: list[str] = []
        self._warn_once = self.warned.append

    def health(self):
        return Health(Level.OK, 'fine')


def watched(graph, name):
    return graph.add(Watched(name, graph.context))


def plain(graph, name):
    return graph.add(Node(name, context=graph.context))


def publish_until(graph, publisher, received):
    """Publish rising numbers until one arrives, and then three more."""
    numbers = count()

    def publish():
        publisher.publish(Int32(data=next(numbers)))
        for _ in range(9):
            graph.executor.spin_once(timeout_sec=0.02)

    graph.until(lambda: bool(received), publish)
    for _ in range(3):
        publish()


def take(received):
    return lambda message: received.append(message.data)


def test_a_subscriber_to_the_former_name_is_served_and_named(graph):
    sender, received = watched(graph, 'new'), []
    publisher = sender.create_publisher(Int32, NEW, 10)
    plain(graph, 'old').create_subscription(Int32, FORMER, take(received), 10)
    publish_until(graph, publisher, received)
    (warning,) = set(sender.warned)
    assert '/old' in warning
    assert NEW in warning


def test_between_new_nodes_each_message_arrives_once(graph):
    sender, listener, received = watched(graph, 'sender'), watched(graph, 'listener'), []
    listener.create_subscription(Int32, NEW, take(received), 10)
    publish_until(graph, sender.create_publisher(Int32, NEW, 10), received)
    assert len(received) == len(set(received)) >= 2
    assert not sender.warned
    assert not [text for text in listener.warned if FORMER in text]
