"""Executor of callbacks in one or several threads, and a worker for the newest message."""

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

# Exceptions of waiting without a result. rclpy raises the first one if a callback closes a
# subscription while another thread begins to wait; the next wait is without it.
_NOTHING_TO_DO = InvalidHandle, ExternalShutdownException, ShutdownException, TimeoutException


class CallbackExecutor(Executor):
    """
    Executor that passes each callback to one of `threads` and waits until it has begun.

    The `MultiThreadedExecutor` of rclpy does not wait. A callback that no thread has begun counts
    as ready and is passed on again and again, which takes a core and delays the threads: joint
    states of 50 Hz were not handled for up to two seconds (issue 1452 of rclpy, not fixed in any
    version that the package supports).
    """

    def __init__(self, threads: int) -> None:
        super().__init__()
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._under_way: set[Task[Any]] = set()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for one callback and begin it; raises exceptions of finished callbacks."""
        with suppress(*_NOTHING_TO_DO):
            task, _, _ = self.wait_for_ready_callbacks(timeout_sec=timeout_sec)
            self._under_way.add(task)
            self._begin(task)
        self._raise()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Shut down after the running callbacks; raises exceptions of finished callbacks."""
        if self._pool is not None:
            # Running callbacks still need what rclpy destroys at shutdown.
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
    Passes messages to `work`, which must not raise, in a thread of its own, one at a time.

    A waiting message is replaced by a newer one, so there is no queue.
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
        """Number of messages that were replaced."""
        return self._dropped

    def take(self, message: Any) -> None:
        """Hand over a message and return at once."""
        with self._changed:
            self._dropped += self._waiting is not None
            self._waiting = message
            self._changed.notify()

    def close(self) -> None:
        """
        End the thread after its current message.

        Python aborts a process that ends while such a thread runs C++ code (issue 1484 of rclpy).
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
