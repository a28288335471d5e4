"""Runs the callbacks of a node, in one thread or in several."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Event
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    ShutdownException,
    TimeoutException,
)
from rclpy.task import Task

# Where a callback closes a subscription as another thread is about to wait for its events, rclpy
# throws the first of these; the next wait goes without it.
_NOTHING_TO_DO = InvalidHandle, ExternalShutdownException, ShutdownException, TimeoutException


class CallbackExecutor(Executor):
    """
    Runs callbacks; with several threads it hands each to one, and goes on once that has begun it.

    rclpy's own `MultiThreadedExecutor` goes on at once. What no thread has begun counts as still
    to do, so it is handed over again and again, at the cost of a core and of the threads, which
    then begin even later: joint states of 50 Hz were not listened to for up to two seconds
    (rclpy's issue 1452, mended in none of the versions that the package runs with).

    Parameters
    ----------
    threads : int
        How many callbacks may run at once.

    """

    def __init__(self, threads: int) -> None:
        super().__init__()
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._under_way: set[Task[Any]] = set()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for one callback and begin it; raises what one raised."""
        with suppress(*_NOTHING_TO_DO):
            task, _, _ = self.wait_for_ready_callbacks(timeout_sec=timeout_sec)
            self._under_way.add(task)
            self._begin(task)
        self._raise()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """End it, after the callbacks under way; raises what one of them raised."""
        if self._pool is not None:
            # They still need what rclpy takes away.
            self._pool.shutdown()
        ended = super().shutdown(timeout_sec)
        self._raise()
        return ended

    def _begin(self, task: Task[Any]) -> None:
        if self._pool is None:
            task()
            return
        begun = Event()

        def run() -> None:
            begun.set()
            task()

        self._pool.submit(run)
        begun.wait()

    def _raise(self) -> None:
        for task in [task for task in self._under_way if task.done()]:
            self._under_way.remove(task)
            task.result()
