"""Handling of SIGINT and SIGTERM: programs end without a traceback, even while they import."""

from __future__ import annotations

# Executables import this module first. Until it is imported, a signal ends the program with a
# traceback; so it must import little.
import os
import signal

TYPE_CHECKING = False  # as in `typing`, without its import
if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import FrameType
    from typing import Any

ENDING = (signal.SIGINT, signal.SIGTERM)


def end_at_once(status: int | None = None) -> None:
    """
    Install handlers that exit the process at once; for the time of imports.

    A KeyboardInterrupt would be lost in imports, or turned into other errors. The status is by
    default that of shells, 128 + the number of the signal.
    """

    def end(number: int, _frame: FrameType | None) -> None:
        os._exit(128 + number if status is None else status)

    for number in ENDING:
        signal.signal(number, end)
    # The parent process may have blocked the signals.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)


class interrupting:  # noqa: N801
    """
    Context manager: raise KeyboardInterrupt at a signal, with its number, so that work cleans up.

    The previous handlers are restored at the first signal. Outside of the main thread, where no
    signals arrive, it does nothing.
    """

    def __enter__(self) -> None:
        # Imported here because this module must import fast.
        from threading import current_thread, main_thread

        if current_thread() is not main_thread():
            self._before: dict[signal.Signals, Any] = {}
            return
        # None means a handler set from C, which Python cannot restore.
        self._before = {n: signal.getsignal(n) or signal.SIG_DFL for n in ENDING}
        for number in ENDING:
            signal.signal(number, self._interrupt)

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _interrupt(self, number: int, _frame: FrameType | None) -> None:
        self.__exit__()
        raise KeyboardInterrupt(number)


def tied_to_parent(command: Sequence[str]) -> list[str]:
    """Command that receives SIGTERM if its parent is killed, if `setpriv` (util-linux) exists."""
    from shutil import which

    setpriv = which('setpriv')
    return [*([setpriv, '--pdeathsig', 'TERM', '--'] if setpriv else []), *command]
