"""Plays a bag onto the topics it was recorded from, with ``/clock``."""

from __future__ import annotations

from functools import partial
from threading import Event, Thread
import time
from typing import Any

from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.factory import time_message
from landmark_nav.nodes.configured import ConfiguredNode
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.run import run_node
from landmark_nav.ros.topics import message_class, RELIABLE, ros_factory, TOPICS
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.definitions import relative_name

_CLOCK_PERIOD_NS = 10_000_000
# Greatest time for acknowledgements of the last messages.
_LAST_WORDS_S = 2.0
# Time for discovery of the topics by subscribers before the first message: DDS takes a second or
# two on a busy machine.
_START_DELAY_S = 3.0


class BagPlayerNode(ConfiguredNode):
    """Publishes the serialised messages unchanged, and shuts down at the end of the bag."""

    def __init__(self, **options: Any) -> None:
        super().__init__('bag_player', 'playback', **options)

    def set_up(self) -> None:
        """Read parameters and files; create topics and services."""
        super().set_up()
        self._bag = Bag(self.required('bag', self.config.bag))
        self._players = {
            topic: self._publisher(topic, kind) for topic, kind in self._bag.types.items()
        }
        self._ticks = self.create_publisher(message_class('rosgraph_msgs/msg/Clock'), '/clock', 10)
        self._played_ns = 0
        self._stop = Event()
        self._player = Thread(target=self._play, daemon=True)
        self.close_with(self._leave)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start the playback, once: it continues to the end of the bag."""
        if self._player.ident is None:
            self._player.start()
        return super().on_activate(state)

    def _leave(self) -> None:
        self._stop.set()
        if self._player.ident is not None:
            self._player.join()

    def health(self) -> Health:
        """OK with the time played."""
        played_s = self._played_ns * 1e-9
        return Health(Level.OK, f'{played_s:.1f} s of {self._bag.duration_s:.1f} s')

    def _publisher(self, topic: str, type_name: str) -> Publisher[Any]:
        try:
            kind = message_class(type_name)
        except (ImportError, AttributeError, ValueError) as error:
            raise LandmarkNavError(
                f'{self._bag.path}: {topic} is of type {type_name}, which is not installed here'
            ) from error
        known = TOPICS.get(relative_name(topic))
        return self.create_publisher(kind, topic, known.qos if known else RELIABLE)

    def _play(self) -> None:
        """Publish all messages, then end the node; runs in its own thread."""
        failure: LandmarkNavError | None = None
        try:
            self._publish_all()
        except Exception as error:
            why = error if isinstance(error, LandmarkNavError) else self.fault('playback', error)
            failure = LandmarkNavError(f'playback ends early: {why}')
        if not self._stop.is_set():
            for publisher in self._players.values():
                publisher.wait_for_all_acked(Duration(seconds=_LAST_WORDS_S))
            if failure is None:
                self.get_logger().info(f'{self._bag.path} is played')
            self.end(failure)

    def _publish_all(self) -> None:
        self.get_logger().info(f'playing {self._bag.path}, {self._bag.duration_s:.1f} s')
        if self._stop.wait(_START_DELAY_S):
            return
        first_ns = next_clock_ns = self._bag.start_ns
        begin = time.monotonic()
        for entry in self._bag.messages():
            # Ticks of the clock up to the message, then its own time.
            while next_clock_ns <= entry.stamp_ns:
                if self._wait_until(begin, next_clock_ns - first_ns):
                    return
                clock = time_message(ros_factory, next_clock_ns)
                self._ticks.publish(ros_factory('rosgraph_msgs/msg/Clock', clock=clock))
                next_clock_ns += _CLOCK_PERIOD_NS
            if self._wait_until(begin, entry.stamp_ns - first_ns):
                return
            self._players[entry.topic].publish(bytes(entry.data))
            self._played_ns = entry.stamp_ns - first_ns

    def _wait_until(self, begin: float, bag_ns: int) -> bool:
        """Wait for the time of a message; return whether the node ends meanwhile."""
        left_s = begin + bag_ns * 1e-9 / self.config.rate - time.monotonic()
        return self._stop.wait(left_s) if left_s > 0.0 else self._stop.is_set()


main = partial(run_node, BagPlayerNode)

if __name__ == '__main__':
    raise SystemExit(main())
