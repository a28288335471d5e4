"""Of which landmarks a triangulated pose was made: pictures tell, as a pose does not."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from landmark_nav.arrays import IndexArray

__all__ = ['FixSources', 'Seen']

# So many of the last pictures tell of which landmarks a pose was made, and so many it is made of.
_PICTURES, _LEAST = 10, 3


class Seen(NamedTuple):
    """A picture's landmarks, by their places in the map, and how many were to be expected."""

    stamp_ns: int
    columns: IndexArray
    expected: int


class FixSources:
    """
    The last pictures, which poses were made of.

    Parameters
    ----------
    landmarks : int
        How many there are in the map.

    """

    def __init__(self, landmarks: int) -> None:
        self._landmarks = landmarks
        self._seen: deque[Seen] = deque(maxlen=_PICTURES)

    def add(self, seen: Seen) -> None:
        """Take note of a picture."""
        self._seen.append(seen)

    def picture(self, stamp_ns: int) -> Seen | None:
        """Return the picture of a time, if it is one of the last."""
        return next((seen for seen in self._seen if seen.stamp_ns == stamp_ns), None)

    def columns(self, stamp_ns: int) -> IndexArray:
        """Landmarks that a pose was made of: those of its picture, of the last ones, or all."""
        for own in (True, False):
            seen = [s.columns for s in self._seen if s.stamp_ns == stamp_ns or not own]
            found = np.unique(np.concatenate(seen)) if seen else ()
            if len(found) >= _LEAST:
                return np.asarray(found)
        return np.arange(self._landmarks)
