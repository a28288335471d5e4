"""What the demo prints on the terminal while it runs."""

from __future__ import annotations

import sys
import time

__all__ = ['Narrator']

_REFRESH_S = 0.2


class Narrator:
    """
    Steps with their time, and a line below that shows how far the present one is.

    That line is drawn on terminals only.
    """

    def __init__(self) -> None:
        self._stream = sys.stdout
        self._begin = time.monotonic()
        self._shown = 0.0
        self._drawn = False

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.monotonic() - self._begin

    def title(self, text: str) -> None:
        """Begin a step."""
        self._clear()
        self._write(f'\n[{self.seconds:5.1f} s] {self._bold(text)}\n')

    def print_line(self, text: str) -> None:
        """Print a result."""
        self._clear()
        self._write(f'          {text}\n')

    def status(self, text: str) -> None:
        """Show how far it is, in place of what was shown before."""
        if not self._stream.isatty() or time.monotonic() - self._shown < _REFRESH_S:
            return
        self._shown = time.monotonic()
        self._drawn = True
        self._write(f'\r\033[K          ... {text}')

    def _clear(self) -> None:
        if self._drawn:
            self._write('\r\033[K')
            self._drawn = False

    def _bold(self, text: str) -> str:
        return f'\033[1m{text}\033[0m' if self._stream.isatty() else text

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()
