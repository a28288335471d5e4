"""`main` of every node, in the face of what rclpy throws."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.waitable import NumberOfEntities, Waitable

from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.run import run_node


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
        from landmark_nav.ros.run import run_node

        class Busy(LandmarkNode):
            def __init__(self):
                super().__init__('busy', 'test')
                group = ReentrantCallbackGroup()
                self.work = self.create_timer(0.05, self.learn, callback_group=group)
                self.create_timer(0.3, self.fail, callback_group=group)

            def learn(self):
                self.work.cancel()
                time.sleep(3.5)

            def fail(self):
                self.end(LandmarkNavError('a wheel fell off'))

        sys.argv = ['busy']
        sys.exit(run_node(Busy, 3))
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
