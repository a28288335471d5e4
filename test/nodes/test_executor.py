"""Callbacks in several threads."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
import time
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.callback_groups import ReentrantCallbackGroup

from landmark_nav.errors import LandmarkNavError
from landmark_nav.ros.factory import ros_factory
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.run import run_node

THREADS = 2


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch, domain_id: int) -> None:
    """Nodes run here, in a domain of their own; at their end they would end the tests."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id))
    monkeypatch.setattr('sys.argv', ['node'])
    monkeypatch.setattr('landmark_nav.ros.run._GRACE_S', 600.0)


class Busy(LandmarkNode):
    """More callbacks than threads, each of which takes its time; ends after some of them."""

    def __init__(self) -> None:
        super().__init__('busy', 'test')
        self.done = 0
        for _ in range(THREADS + 1):
            self.create_timer(0.02, self._work, ReentrantCallbackGroup())

    def health(self) -> Health:
        return Health(Level.OK, 'busy')

    def _work(self) -> None:
        time.sleep(0.05)
        self.done += 1
        if self.done > 20:
            self.end()


def test_what_waits_for_a_thread_is_handed_over_once(monkeypatch: pytest.MonkeyPatch) -> None:
    handed_over = 0
    submit = ThreadPoolExecutor.submit

    def counted(self: ThreadPoolExecutor, *given: Any) -> Future[Any]:
        nonlocal handed_over
        handed_over += 1
        return submit(self, *given)

    monkeypatch.setattr(ThreadPoolExecutor, 'submit', counted)
    made: list[Busy] = []

    def make() -> Busy:
        made.append(Busy())
        return made[0]

    assert run_node(make, THREADS) == 0
    # rclpy's own hands each over four times here, and far more often where there is more to do.
    assert made[0].done <= handed_over < 2 * made[0].done


class Faulty(Busy):
    """Its timers fail, each in a way of its own, before they end it."""

    counted = 0

    def end(self, failure: LandmarkNavError | None = None) -> None:
        self.counted = int(str(self._checked_health().values['dropped: _work']))
        super().end(failure)

    def _work(self) -> None:
        super()._work()
        if self.done % 3 == 0:
            raise ZeroDivisionError
        if self.done % 3 == 1:
            publisher = self.advertise('odom')
            self.destroy_publisher(publisher)
            publisher.publish(ros_factory('nav_msgs/msg/Odometry'))


@pytest.mark.parametrize('threads', [1, THREADS])
def test_a_node_survives_what_its_callbacks_raise(threads: int) -> None:
    made: list[Faulty] = []

    def make() -> Faulty:
        made.append(Faulty())
        return made[0]

    assert run_node(make, threads) == 0
    assert made[0].done > 20
    assert made[0].counted > 10
