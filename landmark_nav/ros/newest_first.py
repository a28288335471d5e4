"""Work on messages in a thread of its own, the newest first."""

from __future__ import annotations

from collections.abc import Callable
from threading import Condition, Thread
from typing import Any

__all__ = ['NewestFirst']


class NewestFirst:
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
        Thread(target=self._run, daemon=True).start()

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

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is not None)
                message, self._waiting = self._waiting, None
            self._work(message)
