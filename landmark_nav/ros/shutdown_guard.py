"""SIGINT and SIGTERM, in whichever thread of the process they arrive."""

from __future__ import annotations

from collections.abc import Callable
import ctypes
import os
import signal
from threading import Thread
import time
from types import FrameType

_SIGEV_THREAD = 2


class _SigEvent(ctypes.Structure):
    _fields_ = (
        ('value', ctypes.c_size_t),
        ('signal', ctypes.c_int),
        ('notify', ctypes.c_int),
        ('function', ctypes.c_void_p),
        ('attribute', ctypes.c_void_p),
        ('_rest', ctypes.c_byte * 32),
    )


class _TimerSpec(ctypes.Structure):
    _fields_ = (
        ('interval_s', ctypes.c_long),
        ('interval_ns', ctypes.c_long),
        ('value_s', ctypes.c_long),
        ('value_ns', ctypes.c_long),
    )


class ExitTimer:
    """
    Ends the process with status 0 some time after its start, whoever holds the interpreter's lock.

    A node that leaves while others do may hold it for tens of seconds: Fast DDS then waits for a
    callback whose mutex it takes again and again (its issue 6513).

    Parameters
    ----------
    after_s : float
        How long after `start`.
    """

    def __init__(self, after_s: float) -> None:
        self._libc = ctypes.CDLL(None)
        self._after = _TimerSpec(0, 0, int(after_s), int(after_s % 1.0 * 1e9))
        self._id = ctypes.c_void_p()
        at_once = ctypes.cast(self._libc._exit, ctypes.c_void_p)
        event = _SigEvent(0, 0, _SIGEV_THREAD, at_once)
        if self._libc.timer_create(
            time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(self._id)
        ):
            raise OSError('timer_create failed')

    def start(self) -> None:
        """From now on the time runs."""
        self._libc.timer_settime(self._id, 0, ctypes.byref(self._after), None)

    def stop(self) -> None:
        """Take it back, for good."""
        self._libc.timer_delete(self._id)


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
