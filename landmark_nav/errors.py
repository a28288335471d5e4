"""The package's root error, the one line that a user reads of it, and the release it is of."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
import reprlib

# A line for a user, and what a path or a value in it keeps at least.
_LINE_LENGTH, _PART_LENGTH = 200, 60
# More is not looked at.
_MAX_LENGTH = 10_000

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

    def __str__(self) -> str:
        """Message without control characters, whatever file or message they came from."""
        return _printable(super().__str__())


class UsageError(LandmarkNavError):
    """An argument of the command line that can not be: exit status 2, as of argparse."""


@contextmanager
def inside(where: object) -> Iterator[None]:
    """Errors in the block say where they are: in a file, a field, a bag."""
    try:
        yield
    except LandmarkNavError as error:
        raise LandmarkNavError(f'{where}: {error}') from error


def release() -> str:
    """Version of the package that is installed, for reports."""
    try:
        return version('landmark_nav')
    except PackageNotFoundError:
        return 'not installed'


def why(error: Exception) -> str:
    """What is wrong with a file: the system's words, without number and temporary name."""
    return getattr(error, 'strerror', None) or str(error)


def shown(value: object) -> str:
    """Value out of a file or message, as an error shows it: on one line, of bounded length."""
    return _shortened(_REPR.repr(value), _PART_LENGTH)


def one_line(text: str) -> str:
    """Text as one line for a user: nothing but printable characters, 200 of them at most."""
    # Where it is too long, paths, values and lists are: between colons.
    parts = _printable(text).split(': ')
    while (excess := len(': '.join(parts)) - _LINE_LENGTH) > 0:
        k = max(range(len(parts)), key=lambda i: len(parts[i]))
        if len(parts[k]) <= _PART_LENGTH:
            return ': '.join(parts)[: _LINE_LENGTH - 1] + '…'
        parts[k] = _shortened(parts[k], max(_PART_LENGTH, len(parts[k]) - excess))
    return ': '.join(parts)


def _printable(text: str) -> str:
    if text.isprintable() and len(text) <= _MAX_LENGTH:
        return text
    escaped = (c if c.isprintable() else ascii(c)[1:-1] for c in text[:_MAX_LENGTH])
    return ''.join(escaped)


def _shortened(text: str, length: int) -> str:
    """Text without its middle; more of the end stays, as there is the name in a path."""
    if len(text) <= length:
        return text
    head = length // 3
    return f'{text[:head]}…{text[len(text) - (length - head - 1) :]}'
