"""The root error of the package, its text in one line, and the installed release."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
import re
import reprlib

# Largest length of a line, of a value in it, and usual one of a topic.
_LINE_LENGTH, _PART_LENGTH, _TOPIC_LENGTH = 200, 60, 24
# Longer texts are cut off.
_MAX_LENGTH = 2_000
# Parentheses, which may hold others; with what divides them from the words before.
_INSIDE = re.compile(r'\((?:[^()]|\([^()]*\))*\)')
_PARENTHESIS = re.compile(f',? ?{_INSIDE.pattern}')

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
    """Prefix errors in the block with their place: a file, a field, a bag; once."""
    try:
        yield
    except LandmarkNavError as error:
        if str(error).startswith(f'{where}: '):
            raise
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


def one_line(text: str, length: int = _LINE_LENGTH) -> str:
    """Text as one line of at most `length` printable characters; whole parts are cut first."""
    # Between colons: first folders, then clauses and parentheses, of the end, the remedy, later.
    parts = _printable(text).split(': ')
    everywhere = range(len(parts))
    details, end = everywhere[:-1], everywhere[-1:]
    steps = [((_without_folder,), details), (_WHOLE, details), (_WHOLE, end)]
    for makers, chosen in [*steps, ((_without_word,), everywhere), ((_shorter,), everywhere)]:
        while (excess := len(': '.join(parts)) - length) > 0:
            made = [(k, make(parts[k])) for k in chosen for make in makers]
            less = [(len(parts[k]) - len(part), k, part) for k, part in made if part != parts[k]]
            if not less:
                break
            # The least that is enough, or else the most.
            enough = [one for one in less if one[0] >= excess]
            _, k, parts[k] = min(enough) if enough else max(less)
    line = ': '.join(parts)
    return line if len(line) <= length else line[: length - 1] + '…'


def _printable(text: str) -> str:
    if text.isprintable() and len(text) <= _MAX_LENGTH:
        return text
    escaped = (c if c.isprintable() else ascii(c)[1:-1] for c in text[:_MAX_LENGTH])
    return ''.join(escaped)


def _without_folder(text: str) -> str:
    """Long path without its first folder; other text, as that of topics, as it is."""
    rest = text.removeprefix('…/').lstrip('/').partition('/')[2]
    return f'…/{rest}' if rest and ' ' not in text and len(text) > _TOPIC_LENGTH else text


def _without_clause(text: str) -> str:
    """Text without the shorter of its last two clauses, or the only one after the first."""
    kept = text.replace(', …', '')
    masked = _INSIDE.sub(lambda found: '_' * len(found[0]), kept)
    ends = [found.start() for found in re.finditer('[,;] ', masked)]
    if not ends:
        return text
    last = kept[ends[-1] :]
    # The last clause may end a sentence.
    is_short = len(ends) == 1 or len(last) < ends[-1] - ends[-2]
    return f'{kept[: ends[-1]]}, …' if is_short else f'{kept[: ends[-2]]}, …{last}'


def _without_parenthesis(text: str) -> str:
    """Text without its longest parenthesis."""
    longest = max(_PARENTHESIS.findall(text), key=len, default='')
    return text.replace(longest, '', 1) if longest else text


_WHOLE = _without_clause, _without_parenthesis


def _without_word(text: str) -> str:
    """Text without the word in the middle."""
    words = text.split(' ')
    left = [k for k, word in enumerate(words) if word != '…']
    if len(left) < 3:
        return text
    words[left[len(left) // 2]] = '…'
    return re.sub('…( …)+', '…', ' '.join(words))


def _shorter(text: str) -> str:
    return _shortened(text, max(len(text) - 1, 1))


def _shortened(text: str, length: int) -> str:
    """Text without its middle; more of the end is kept, where a path has the file name."""
    if len(text) <= length:
        return text
    head = length // 3
    return f'{text[:head]}…{text[len(text) - (length - head - 1) :]}'
