"""SIGINT and SIGTERM end a program quietly, from its first line on."""

from __future__ import annotations

# Executables import this first of all, and nothing else before: each import is time in which a
# signal ends the program as Python does by itself.
import os
import signal

TYPE_CHECKING = False  # as in `typing`, without its import
if TYPE_CHECKING:
    from types import FrameType
    from typing import Any

ENDING = (signal.SIGINT, signal.SIGTERM)


def end_at_once(status: int | None = None) -> None:
    """
    End the process at a signal, whatever it does: while it imports it has nothing to lose.

    A KeyboardInterrupt would do harm there: imports turn it into other errors, or lose it.

    Parameters
    ----------
    status : int, optional
        Exit status; by default that of shells, 128 + the number of the signal.
    """

    def end(number: int, _frame: FrameType | None) -> None:
        os._exit(128 + number if status is None else status)

    for number in ENDING:
        signal.signal(number, end)
    # Whoever started this program may have held signals back until now.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)


class interrupting:  # noqa: N801
    """
    Context manager: raise KeyboardInterrupt at a signal, with its number, so that work cleans up.

    A second signal does what it did before the block. Outside of the main thread, where signals
    do not arrive, the block is as any other.
    """

    def __enter__(self) -> None:
        """From here on a signal interrupts."""
        # Not on top: what executables import first of all is to be short.
        from threading import current_thread, main_thread

        if current_thread() is not main_thread():
            self._before: dict[signal.Signals, Any] = {}
            return
        # None is a handler of a library written in C, which Python cannot set again.
        self._before = {n: signal.getsignal(n) or signal.SIG_DFL for n in ENDING}
        for number in ENDING:
            signal.signal(number, self._interrupt)

    def __exit__(self, *error: object) -> None:
        """Signals are again what they were before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _interrupt(self, number: int, _frame: FrameType | None) -> None:
        self.__exit__()
        raise KeyboardInterrupt(number)
