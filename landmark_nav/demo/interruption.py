"""SIGINT and SIGTERM, heeded where it does no harm."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any

__all__ = ['Interruption']

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """
    Context manager, for the main thread: a signal is noted there, and `check` raises it.

    A KeyboardInterrupt that is raised wherever the program happens to be is lost in a destructor,
    which is where a program that waits with rclpy is one time in forty.
    """

    def __init__(self) -> None:
        self._noted = False
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        """From here on signals are only noted."""
        self._handlers = {number: signal.signal(number, self._note) for number in _SIGNALS}
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        """Signals are again what they were before; one that was not heeded is raised."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if kind is None:
            self.check()

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if there was a signal."""
        if self._noted:
            raise KeyboardInterrupt

    def _note(self, _number: int, _frame: FrameType | None) -> None:
        self._noted = True
