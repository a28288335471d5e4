"""SIGINT and SIGTERM end a program quietly, from its first line on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import os
import signal
from types import FrameType

__all__ = ['ENDING', 'end_at_once', 'interrupting']

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


@contextmanager
def interrupting() -> Iterator[None]:
    """
    Raise KeyboardInterrupt at a signal, with its number, so that work in the block cleans up.

    A second signal does what it did before the block. Outside of the main thread, where signals
    do not arrive, the block is as any other.
    """
    # Not on top: what executables import first of all is to be short.
    from threading import current_thread, main_thread

    if current_thread() is not main_thread():
        yield
        return

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def interrupt(number: int, _frame: FrameType | None) -> None:
        restore()
        raise KeyboardInterrupt(number)

    # None is a handler of a library written in C, which Python cannot set again.
    before = {number: signal.getsignal(number) or signal.SIG_DFL for number in ENDING}
    try:
        for number in ENDING:
            signal.signal(number, interrupt)
        yield
    finally:
        restore()
