"""The root error of the package, its text in one line, and the installed release."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
import reprlib

# Largest length of a line, and smallest lengths to which its values and paths are shortened.
_LINE_LENGTH, _PART_LENGTH, _PATH_LENGTH = 200, 60, 24
# Longer texts are cut off.
_MAX_LENGTH = 10_000

_REPR = reprlib.Repr()
_REPR.maxlevel, _REPR.maxlist, _REPR.maxtuple, _REPR.maxdict = 2, 6, 6, 3
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 50


class LandmarkNavError(Exception):
    """
    Bad input that a user can fix.

    The message is one line that says what is wrong, where, and what to do. Commands print it on
    stderr and exit with status 1; services return it with ``success: false``. Normal failures (too
    few landmarks, a degenerate triplet) are not errors, but a `Refusal`.
    """

    def __str__(self) -> str:
        """Message without control characters, which files and messages may contain."""
        return _printable(super().__str__())


class UsageError(LandmarkNavError):
    """An invalid argument on the command line: exit status 2, as by argparse."""


@contextmanager
def inside(where: object) -> Iterator[None]:
    """Prefix errors in the block with their place: a file, a field, a bag."""
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
    """Text of an error of the operating system, without its number and the file name."""
    return getattr(error, 'strerror', None) or str(error)


def shown(value: object) -> str:
    """Text of a value from a file or message for an error: one line of bounded length."""
    return _shortened(_REPR.repr(value), _PART_LENGTH)


def one_line(text: str) -> str:
    """Text as one line of at most 200 printable characters."""
    # Between colons, paths are shortened first, then values and lists, the longest first.
    parts = _printable(text).split(': ')
    for least in (_PATH_LENGTH, _PART_LENGTH):
        for k in sorted(range(len(parts)), key=lambda i: -len(parts[i])):
            excess = len(': '.join(parts)) - _LINE_LENGTH
            is_path = '/' in parts[k] and ' ' not in parts[k]
            if excess > 0 and (is_path or least == _PART_LENGTH):
                parts[k] = _shortened(parts[k], max(least, len(parts[k]) - excess))
    line = ': '.join(parts)
    return line if len(line) <= _LINE_LENGTH else line[: _LINE_LENGTH - 1] + '…'


def _printable(text: str) -> str:
    if text.isprintable() and len(text) <= _MAX_LENGTH:
        return text
    escaped = (c if c.isprintable() else ascii(c)[1:-1] for c in text[:_MAX_LENGTH])
    return ''.join(escaped)


def _shortened(text: str, length: int) -> str:
    """Text without its middle; more of the end is kept, where a path has the file name."""
    if len(text) <= length:
        return text
    head = length // 3
    return f'{text[:head]}…{text[len(text) - (length - head - 1) :]}'
