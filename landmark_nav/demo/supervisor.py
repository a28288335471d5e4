"""Processes that belong together: started, watched, and ended as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
import os
from pathlib import Path
import shutil
import signal
import subprocess
import time
from types import FrameType
from typing import Any

from landmark_nav.errors import LandmarkNavError

_POLL_S = 0.05
_LAST_LINES = 4


class ProcessEndedError(LandmarkNavError):
    """A process ended that should have gone on."""


@dataclass(frozen=True)
class _Child:
    name: str
    process: subprocess.Popen[bytes]
    log: Path | None


class Supervisor:
    """
    Context manager over child processes, each in a process group of its own.

    Where there is `setpriv` (util-linux), they also end, by SIGTERM, if this process is killed.

    Parameters
    ----------
    log_folder : Path or None
        Where what each of them prints goes, ``NAME.log``; None where it goes where ours goes.
    grace_s : float
        How long each signal may take at the end.
    """

    def __init__(
        self, log_folder: Path | None, environment: Mapping[str, str], grace_s: float = 10.0
    ) -> None:
        self._log_folder = log_folder
        self._environment = dict(environment)
        self._grace_s = grace_s
        self._children: list[_Child] = []
        setpriv = shutil.which('setpriv')
        self._wrapper = [setpriv, '--pdeathsig', 'TERM', '--'] if setpriv else []
        if log_folder is not None:
            log_folder.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Supervisor:
        """Return itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """End all that are left."""
        self.stop()

    def start(self, name: str, command: Sequence[str]) -> subprocess.Popen[bytes]:
        """Start one; its own process group keeps a Ctrl-C at the terminal from it."""
        log = None if self._log_folder is None else self._log_folder / f'{name}.log'
        with log.open('wb') if log else nullcontext() as output:
            process = subprocess.Popen(
                [*self._wrapper, *command],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT if log else None,
                env=self._environment,
                start_new_session=True,
            )
        self._children.append(_Child(name, process, log))
        return process

    def check(self) -> None:
        """
        Look after all of them.

        Raises
        ------
        ProcessEndedError
            One has ended; the message says which, how, and its last lines.
        """
        for child in self._children:
            status = child.process.poll()
            if status is not None:
                words = f': {_last_words(child.log)} (all: {child.log})' if child.log else ''
                raise ProcessEndedError(f'{child.name} ended with {_described(status)}{words}')

    def stop(self, gently: signal.Signals = signal.SIGTERM) -> dict[str, int]:
        """
        End all, gently at first and at last by force; returns exit statuses by name.

        Not by SIGINT: what is still importing may lose the KeyboardInterrupt.
        """
        for number in (gently, signal.SIGKILL):
            running = [child for child in self._children if child.process.poll() is None]
            for child in running:
                # Its id is that of its group, which also ends what it may have started.
                os.killpg(child.process.pid, number)
            deadline = time.monotonic() + self._grace_s
            while time.monotonic() < deadline and any(
                child.process.poll() is None for child in running
            ):
                time.sleep(_POLL_S)
        statuses = {child.name: child.process.wait() for child in self._children}
        self._children = []
        return statuses


def _described(status: int) -> str:
    if status < 0:
        return f'signal {signal.Signals(-status).name}'
    return f'exit status {status}'


def _last_words(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(errors='replace').splitlines()]
    last_lines = [line for line in lines if line][-_LAST_LINES:]
    return ' | '.join(last_lines) or 'it printed nothing'


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
