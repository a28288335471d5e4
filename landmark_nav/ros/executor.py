"""Runs the callbacks of a node, in one thread or in several, and work on the newest input."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Condition, Event, Thread
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


class LatestOnlyWorker:
    """
    Calls back with messages, one at a time, while the executor goes on with others.

    What waits makes way for what is newer, so nothing queues up.

    Parameters
    ----------
    work : callable
        Called with each message, in the thread; it raises nothing.
    """

    def __init__(self, work: Callable[[Any], None]) -> None:
        self._work = work
        self._waiting: Any = None
        self._changed = Condition()
        self._dropped = 0
        self._closed = False
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """How many messages made way."""
        return self._dropped

    def take(self, message: Any) -> None:
        """Hand over a message and return at once."""
        with self._changed:
            self._dropped += self._waiting is not None
            self._waiting = message
            self._changed.notify()

    def close(self) -> None:
        """
        End the thread, after the message that it works on.

        Python aborts the process if it ends while such a thread is in a library written in C++
        (rclpy's issue 1484).
        """
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting is not None)
                if self._closed:
                    return
                message, self._waiting = self._waiting, None
            self._work(message)
