"""The package's root error, and the one line that a user reads of it."""

from __future__ import annotations

import re
import reprlib

__all__ = ['LandmarkNavError', 'UsageError', 'one_line', 'shown', 'why']

# A line for a user, and one word in it: paths and values may be of any length.
_LINE_LENGTH, _WORD_LENGTH = 200, 70

_REPR = reprlib.Repr()
_REPR.maxlevel, _REPR.maxlist, _REPR.maxtuple, _REPR.maxdict = 2, 6, 6, 3
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 50


class LandmarkNavError(Exception):
    """
    Bad input that a user can mend.

    The message is one line that says what is wrong, where, and what to do. Commands print it on
    stderr and exit with status 1; services answer it with ``success: false``. What is merely to
    be expected (too few landmarks, a degenerate triplet) is a typed result instead.
    """


class UsageError(LandmarkNavError):
    """An argument of the command line that can not be: exit status 2, as of argparse."""


def why(error: Exception) -> str:
    """What is wrong with a file: the system's words, without number and temporary name."""
    return getattr(error, 'strerror', None) or str(error)


def shown(value: object) -> str:
    """Value out of a file or message, as an error shows it: on one line, of bounded length."""
    return _shortened(_REPR.repr(value), _WORD_LENGTH)


def one_line(text: str) -> str:
    """Text as one line for a user: nothing but printable characters, 200 of them at most."""
    line = ''.join(
        c if c.isprintable() else c.encode('unicode_escape').decode() for c in text[:100_000]
    )
    if len(line) > _LINE_LENGTH:
        long_word = rf'\S{{{_WORD_LENGTH},}}'
        line = re.sub(long_word, lambda word: _shortened(word[0], _WORD_LENGTH), line)
    return _shortened(line, _LINE_LENGTH)


def _shortened(text: str, length: int) -> str:
    """Text without its middle; more of the end stays, as there is the name in a path."""
    if len(text) <= length:
        return text
    head = length // 3
    return f'{text[:head]}…{text[len(text) - (length - head - 1) :]}'
