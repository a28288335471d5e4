from __future__ import annotations

from threading import Event
import time

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from landmark_nav.ros.executor import LatestOnlyWorker
from landmark_nav.ros.latency import Latency


def test_what_waits_makes_way_for_what_is_newer() -> None:
    done: list[int] = []
    go, began = Event(), Event()

    def work(number: int) -> None:
        began.set()
        go.wait(5.0)
        done.append(number)

    worker = LatestOnlyWorker(work)
    worker.take(0)
    assert began.wait(5.0)
    for number in range(1, 6):
        worker.take(number)
    go.set()
    deadline = time.monotonic() + 5.0
    while len(done) < 2 and time.monotonic() < deadline:
        time.sleep(0.005)
    assert done == [0, 5]
    assert worker.dropped == 4


def test_the_thread_ends_after_what_it_is_at() -> None:
    done: list[int] = []
    began = Event()

    def work(number: int) -> None:
        began.set()
        time.sleep(0.2)
        done.append(number)

    worker = LatestOnlyWorker(work)
    worker.take(0)
    assert began.wait(5.0)
    worker.take(1)
    worker.close()
    worker.take(2)
    assert done == [0]
    time.sleep(0.3)
    assert done == [0]


def test_ages_by_another_clock_are_none() -> None:
    latency = Latency()
    assert latency.values() == {}
    latency.note(10**18)
    assert latency.values() == {}
    for age_ms in range(1, 101):
        latency.note(age_ms * 10**6)
    assert latency.values() == {'latency_median_ms': '50', 'latency_p95_ms': '95'}
