"""Shutdown by SIGINT and SIGTERM within a time limit."""

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
    Ends the process with status 0, `after_s` after `start`, without the interpreter lock.

    Nodes that leave at the same time may hold that lock for tens of seconds: Fast DDS waits for a
    callback whose mutex it takes repeatedly (its issue 6513).
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
        """Start the timer."""
        self._libc.timer_settime(self._id, 0, ctypes.byref(self._after), None)

    def stop(self) -> None:
        """Delete the timer."""
        self._libc.timer_delete(self._id)


_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class ShutdownGuard:
    """
    Context manager for the main thread: a signal requests the end and limits the time to it.

    A separate thread waits for the signal and calls `on_signal`: handlers of Python do not run
    while the main thread is in C code, and a KeyboardInterrupt may be lost in a callback. If the
    block has not ended `grace_s` later, the process ends with status 0.
    """

    def __init__(self, on_signal: Callable[[], None], grace_s: float) -> None:
        self._on_signal = on_signal
        self._timer = ExitTimer(grace_s)
        self._thread = Thread(target=self._watch, name='end signals', daemon=True)

    def __enter__(self) -> ShutdownGuard:
        """Replace the handlers of the signals."""
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._wakeup = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._handlers = {number: signal.signal(number, _noted) for number in _SIGNALS}
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Restore the handlers of the signals."""
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        os.close(self._writer)
        self._thread.join()
        os.close(self._reader)
        self._timer.stop()

    def expect_end(self) -> None:
        """Start the time limit for the end of the block."""
        self._timer.start()

    def _watch(self) -> None:
        if os.read(self._reader, 1):
            self.expect_end()
            self._on_signal()


def _noted(_number: int, _frame: FrameType | None) -> None:
    """Do nothing: Python writes to the wakeup pipe only for signals with a handler."""
