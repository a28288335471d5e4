"""An end of the process that needs nothing of Python; see timer_create(2)."""

from __future__ import annotations

import ctypes
import time

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
