"""What of a bag cannot be used: named, left out and reported."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import numpy as np
from scipy.ndimage import median_filter

from landmark_nav.arrays import IntArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.bags.reader import Bag, BagMessage

__all__ = ['MessageFilter', 'naming', 'wrong_stamps']

T = TypeVar('T')


# Stamps that differ by more from the time of recording than those around them are wrong.
_WRONG_STAMP_NS = 500_000_000
# So many messages around each show what is usual; a clock that is set back changes it for all.
_AROUND = 5


def wrong_stamps(stamps_ns: IntArray) -> dict[tuple[int, int], int]:
    """
    Messages whose stamps are wrong, by log time and stamp; by how much, nanoseconds.

    Parameters
    ----------
    stamps_ns : ndarray of int, shape (n, 2)
        Log time and stamp of each message of a topic.

    """
    if len(stamps_ns) < _AROUND:
        return {}
    offsets = stamps_ns[:, 1] - stamps_ns[:, 0]
    middle = _AROUND // 2
    at = np.clip(np.arange(len(offsets)), middle, len(offsets) - 1 - middle)
    off = offsets - median_filter(offsets, _AROUND)[at]
    wrong = np.flatnonzero(np.abs(off) > _WRONG_STAMP_NS)
    return {(int(stamps_ns[k, 0]), int(stamps_ns[k, 1])): int(off[k]) for k in wrong}


@contextmanager
def naming(bag: Bag, topic: str) -> Iterator[None]:
    """Complaints from inside name the bag and the topic."""
    try:
        yield
    except LandmarkNavError as error:
        if str(error).startswith(str(bag.path)):
            raise
        raise LandmarkNavError(f'{bag.path}: {topic}: {error}') from error
    except AttributeError as error:
        # The bag brings its own definitions: fields may be called otherwise, or be damaged.
        raise LandmarkNavError(
            f'{bag.path}: {topic}: its definition in the bag differs from the one of ROS 2 '
            f'({error}): record it again'
        ) from error


class MessageFilter:
    """
    Leaves out what of a topic cannot be used, and reports it once.

    That is what its decoder refuses, and a message whose stamp differs from those around it as no
    transport delays a message: it would be put into another time.

    Parameters
    ----------
    bag : Bag
        Whose topic it is.
    topic : str
        Its name in the bag.
    what : str
        What it holds, for the complaint.
    needed : bool
        Whether there must be something of it.

    """

    def __init__(
        self, bag: Bag, topic: str, what: str = 'messages', *, needed: bool = True
    ) -> None:
        self._bag, self._topic, self._what, self._needed = bag, topic, what, needed
        self._wrong_stamp_ns = wrong_stamps(bag.stamps_ns.get(topic, np.empty((0, 2), np.int64)))
        self._used = 0
        self._complaints: list[str] = []

    def take(self, decode: Callable[[BagMessage], T], entry: BagMessage) -> T | None:
        """What `decode` makes of a message; None if that is bad input."""
        try:
            with naming(self._bag, self._topic):
                if (
                    off_ns := self._wrong_stamp_ns.get((entry.stamp_ns, entry.header_ns))
                ) is not None:
                    raise LandmarkNavError(
                        f'the stamp {1e-9 * entry.header_ns:.3f} s is {1e-9 * off_ns:+.3f} s off '
                        'those around it: its publisher must stamp it'
                    )
                event = decode(entry)
        except LandmarkNavError as error:
            self._complaints.append(str(error))
            return None
        self._used += 1
        return event

    def report(self) -> None:
        """Warn of what was left out; `LandmarkNavError` if that was all."""
        if not self._complaints:
            return
        if not self._used and self._needed:
            raise LandmarkNavError(self._complaints[0])
        count = len(self._complaints)
        self._bag.warn(
            f'{count} of {self._used + count} {self._what} left out: {self._complaints[0]}'
        )
