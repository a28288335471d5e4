"""What of a bag cannot be used: named, left out and told."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.bags.reader import Bag, BagMessage

__all__ = ['Sieve', 'naming']

T = TypeVar('T')


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


class Sieve:
    """
    Leaves out what of a topic cannot be used, and tells of it once.

    Parameters
    ----------
    bag : Bag
        Whose topic it is.
    topic : str
        Its name in the bag.
    what : str
        What it holds, for the complaint.

    """

    def __init__(self, bag: Bag, topic: str, what: str = 'messages') -> None:
        self._bag, self._topic, self._what = bag, topic, what
        self._used = 0
        self._complaints: list[str] = []

    def take(self, decode: Callable[[BagMessage], T], entry: BagMessage) -> T | None:
        """What `decode` makes of a message; None if that is bad input."""
        try:
            with naming(self._bag, self._topic):
                event = decode(entry)
        except LandmarkNavError as error:
            self._complaints.append(str(error))
            return None
        self._used += 1
        return event

    def tell(self) -> None:
        """Warn of what was left out; `LandmarkNavError` if that was all."""
        if not self._complaints:
            return
        if not self._used:
            raise LandmarkNavError(self._complaints[0])
        count = len(self._complaints)
        self._bag.warn(
            f'{count} of {self._used + count} {self._what} left out: {self._complaints[0]}'
        )
