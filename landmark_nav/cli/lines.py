"""Lines for a terminal."""

from __future__ import annotations

from collections.abc import Iterable
import shutil
from textwrap import fill

__all__ = ['wrapped']

_WIDTH = 99
_LEAST_WIDTH = 60


def wrapped(lines: Iterable[str]) -> str:
    """Lines as one text; what is too long goes on in the next line, further to the right."""
    columns = shutil.get_terminal_size((_WIDTH, 24)).columns
    width = min(max(columns, _LEAST_WIDTH), _WIDTH)
    return '\n'.join(
        fill(
            line,
            width,
            subsequent_indent=' ' * (len(line) - len(line.lstrip()) + 4),
            break_long_words=False,
            break_on_hyphens=False,
        )
        for line in lines
    )
