"""Callbacks in several threads, and `main` of the nodes when rclpy raises errors."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
import os
import signal
import subprocess
import sys
import textwrap
import time
from typing import Any

import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.waitable import NumberOfEntities, Waitable

from landmark_nav.errors import LandmarkNavError
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.run import run_node
from landmark_nav.ros.topics import ros_factory

pytest.importorskip('rclpy', reason='ROS 2 is not installed')


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


pytest.importorskip('rclpy', reason='ROS 2 is not installed')


class ClosedMeanwhile(Waitable[None]):
    """Was closed by another thread as the executor gathered what it waits for."""

    thrown = 0

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        pass

    def add_to_wait_set(self, wait_set: object) -> None:
        self.thrown += 1
        if self.thrown == 1:
            raise InvalidHandle('destruction was requested')

    def get_num_entities(self) -> NumberOfEntities:
        return NumberOfEntities()

    def is_ready(self, wait_set: object) -> bool:
        return False


class Quiet(LandmarkNode):
    """Does nothing of its own."""

    def health(self) -> Health:
        return Health(Level.OK, 'well')


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('threads', [1, 3])
def test_a_subscription_closed_by_another_thread_does_not_end_the_node(
    threads: int, number: signal.Signals, monkeypatch: pytest.MonkeyPatch, domain_id: int
) -> None:
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id))
    monkeypatch.setattr('sys.argv', ['node'])
    # At its end the node would end the tests.
    monkeypatch.setattr('landmark_nav.ros.run._GRACE_S', 600.0)
    waitable = ClosedMeanwhile(ReentrantCallbackGroup())
    ticks: list[int] = []

    def make() -> LandmarkNode:
        node = Quiet('closes_things', 'test')
        node.add_waitable(waitable)

        def tick() -> None:
            ticks.append(waitable.thrown)
            if len(ticks) == 5:
                os.kill(os.getpid(), number)

        node.create_timer(0.02, tick)
        return node

    assert run_node(make, threads) == 0
    assert waitable.thrown > 1
    assert len(ticks) >= 5


def test_a_callback_that_fails_leaves_the_node_alive(
    monkeypatch: pytest.MonkeyPatch, domain_id: int
) -> None:
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id))
    monkeypatch.setattr('sys.argv', ['node'])
    made: list[LandmarkNode] = []

    def make() -> LandmarkNode:
        node = Quiet('fails', 'test')
        made.append(node)

        def fail() -> None:
            raise RuntimeError('a wheel fell off')

        def end_after_two() -> None:
            if node.internal_errors >= 2:
                node.end()

        node.create_timer(0.05, fail, callback_group=ReentrantCallbackGroup())
        node.create_timer(0.05, end_after_two, callback_group=ReentrantCallbackGroup())
        return node

    assert run_node(make, 3) == 0
    assert made[0].internal_errors >= 2


def test_a_failure_sets_the_status_though_another_callback_takes_longer_than_the_grace(
    domain_id: int,
) -> None:
    script = """
        import sys, time
        from rclpy.callback_groups import ReentrantCallbackGroup
        from landmark_nav.errors import LandmarkNavError
        from landmark_nav.ros.node import LandmarkNode
        from landmark_nav.ros import run

        class Busy(LandmarkNode):
            def __init__(self):
                super().__init__('busy', 'test')
                group = ReentrantCallbackGroup()
                self.work = self.create_timer(0.05, self.learn, callback_group=group)
                self.create_timer(0.3, self.fail, callback_group=group)

            def learn(self):
                self.work.cancel()
                time.sleep(1.0)

            def fail(self):
                self.end(LandmarkNavError('a wheel fell off'))

        sys.argv, run._GRACE_S = ['busy'], 0.3
        sys.exit(run.run_node(Busy, 3))
    """
    done = subprocess.run(
        [sys.executable, '-c', textwrap.dedent(script)],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain_id)},
    )
    assert done.returncode == 1
    assert 'a wheel fell off' in done.stderr
