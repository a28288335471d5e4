"""Lines for a terminal."""

from __future__ import annotations

from collections.abc import Iterable
from textwrap import fill

__all__ = ['wrapped']

_WIDTH = 99


def wrapped(lines: Iterable[str]) -> str:
    """Lines as one text; what is too long goes on in the next line, further to the right."""
    return '\n'.join(
        fill(
            line,
            _WIDTH,
            subsequent_indent=' ' * (len(line) - len(line.lstrip()) + 4),
            break_long_words=False,
            break_on_hyphens=False,
        )
        for line in lines
    )
