"""Callbacks in several threads, and `main` of the nodes when rclpy raises errors."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.waitable import NumberOfEntities, Waitable

from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.run import run_node
from landmark_nav.ros.topics import ros_factory

THREADS = 2


@pytest.fixture(autouse=True)
def alone(monkeypatch, domain_id):
    """Nodes run here, in a domain of their own; at their end they would end the tests."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id))
    monkeypatch.setattr('sys.argv', ['node'])
    monkeypatch.setattr('landmark_nav.ros.run._GRACE_S', 600.0)


class Busy(LandmarkNode):
    """More callbacks than threads, each of which takes its time; ends after some of them."""

    def __init__(self):
        super().__init__('busy', 'test')
        self.done = 0
        for _ in range(THREADS + 1):
            self.create_timer(0.02, self._work, ReentrantCallbackGroup())

    def health(self):
        return Health(Level.OK, 'busy')

    def _work(self):
        time.sleep(0.05)
        self.done += 1
        if self.done > 20:
            self.end()


class Faulty(Busy):
    """Its timers fail, each in a way of its own, before they end it."""

    counted = 0

    def end(self, failure=None):
        self.counted = int(str(self._checked_health().values['dropped: _work']))
        super().end(failure)

    def _work(self):
        super()._work()
        if self.done % 3 == 0:
            raise ZeroDivisionError
        if self.done % 3 == 1:
            publisher = self.advertise('odom')
            self.destroy_publisher(publisher)
            publisher.publish(ros_factory('nav_msgs/msg/Odometry'))


@pytest.mark.parametrize('threads', [1, THREADS])
def test_a_node_survives_what_its_callbacks_raise(threads):
    made: list[Faulty] = []

    def make():
        made.append(Faulty())
        return made[0]

    assert run_node(make, threads=threads) == 0
    assert made[0].done > 20
    assert made[0].counted > 10


class ClosedMeanwhile(Waitable[None]):
    """Was closed by another thread as the executor gathered what it waits for."""

    thrown = 0

    def __enter__(self):
        pass

    def __exit__(self, *_):
        pass

    def add_to_wait_set(self, wait_set):
        self.thrown += 1
        if self.thrown == 1:
            raise InvalidHandle('destruction was requested')

    def get_num_entities(self):
        return NumberOfEntities()

    def is_ready(self, wait_set):
        return False


class Quiet(LandmarkNode):
    """Does nothing of its own."""

    def health(self):
        return Health(Level.OK, 'well')


@pytest.mark.parametrize(('threads', 'number'), [(1, signal.SIGTERM), (3, signal.SIGINT)])
def test_a_subscription_closed_by_another_thread_does_not_end_the_node(threads, number):
    waitable = ClosedMeanwhile(ReentrantCallbackGroup())
    ticks: list[int] = []

    def make():
        node = Quiet('closes_things', 'test')
        node.add_waitable(waitable)

        def tick():
            ticks.append(waitable.thrown)
            if len(ticks) == 5:
                os.kill(os.getpid(), number)

        node.create_timer(0.02, tick)
        return node

    assert run_node(make, threads=threads) == 0
    assert waitable.thrown > 1
    assert len(ticks) >= 5


def test_a_failure_sets_the_status_though_another_callback_takes_longer_than_the_grace(domain_id):
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
        sys.exit(run.run_node(Busy, threads=3))
    """
    done = subprocess.run(
        [sys.executable, '-c', textwrap.dedent(script)], capture_output=True, text=True,
        timeout=60, env={**os.environ, 'ROS_DOMAIN_ID': str(domain_id)},
    )  # fmt: skip
    assert done.returncode == 1
    assert 'a wheel fell off' in done.stderr
