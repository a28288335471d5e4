"""SIGINT and SIGTERM, in whichever thread of the process they arrive."""

from __future__ import annotations

from collections.abc import Callable
import os
import signal
from threading import Thread
from types import FrameType

from landmark_nav.ros.exit_timer import ExitTimer

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class ShutdownGuard:
    """
    Context manager, for the main thread: a signal asks for the end, and sees that it comes.

    A thread of its own waits for the signal, since Python's handlers do not run while the main
    thread waits in a library written in C, and a KeyboardInterrupt may be lost in a callback.

    Parameters
    ----------
    on_signal : callable
        Asks those in the context to leave it; called in that thread.
    grace_s : float
        The process ends with status 0 if the context is not left by then.

    """

    def __init__(self, on_signal: Callable[[], None], grace_s: float) -> None:
        self._on_signal = on_signal
        self._timer = ExitTimer(grace_s)
        self._thread = Thread(target=self._watch, name='end signals', daemon=True)

    def __enter__(self) -> ShutdownGuard:
        """From here on nothing else acts on the signals."""
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._wakeup = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._handlers = {number: signal.signal(number, _noted) for number in _SIGNALS}
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Signals are again what they were before."""
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        os.close(self._writer)
        self._thread.join()
        os.close(self._reader)
        self._timer.stop()

    def expect_end(self) -> None:
        """The process ends if the context is not left within the grace."""
        self._timer.start()

    def _watch(self) -> None:
        if os.read(self._reader, 1):
            self.expect_end()
            self._on_signal()


def _noted(_number: int, _frame: FrameType | None) -> None:
    """Python writes to the pipe only for signals that have a handler."""
