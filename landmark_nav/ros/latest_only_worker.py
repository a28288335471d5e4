"""Work on messages in a thread of its own, the newest first."""

from __future__ import annotations

from collections.abc import Callable
from threading import Condition, Thread
from typing import Any


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
