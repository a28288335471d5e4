"""The package's one root error."""

from __future__ import annotations

__all__ = ['LandmarkNavError', 'one_line', 'why']


class LandmarkNavError(Exception):
    """
    Bad input that a user can mend.

    The message is one line that says what is wrong, where, and what to do. Commands print it on
    stderr and exit with status 1; services answer it with ``success: false``. What is merely to
    be expected (too few landmarks, a degenerate triplet) is a typed result instead.
    """


def why(error: Exception) -> str:
    """What is wrong with a file: the system's words, without number and temporary name."""
    return getattr(error, 'strerror', None) or str(error)


def one_line(text: str) -> str:
    """Text as one line for a user: nothing but printable characters, 200 of them at most."""
    plain = ''.join(c if c.isprintable() else ' ' for c in text[:1000])
    return plain if len(plain) <= 200 else f'{plain[:199]}…'
