"""An executor that runs callbacks in several threads."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import Any

from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    ShutdownException,
    TimeoutException,
)
from rclpy.task import Task

__all__ = ['ThreadPool']


class ThreadPool(Executor):
    """
    Hands each callback to one of several threads, and goes on once that has begun it.

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
        self._pool = ThreadPoolExecutor(threads)
        self._under_way: set[Task[Any]] = set()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for one callback and begin it; raises what an earlier one raised."""
        try:
            task, _, _ = self.wait_for_ready_callbacks(timeout_sec=timeout_sec)
        except (ExternalShutdownException, ShutdownException, TimeoutException):
            return
        begun = Event()

        def run() -> None:
            begun.set()
            task()

        self._pool.submit(run)
        begun.wait()
        self._under_way.add(task)
        for done in [task for task in self._under_way if task.done()]:
            self._under_way.remove(done)
            done.result()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """End it, after the callbacks under way."""
        ended = super().shutdown(timeout_sec)
        self._pool.shutdown()
        return ended
