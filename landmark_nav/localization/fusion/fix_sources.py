"""Which landmarks a triangulated pose rests on: its message does not say, the images do."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from landmark_nav.arrays import IndexArray

__all__ = ['FixSources', 'Seen']

# So many images are remembered; a pose rests on so many landmarks at least.
_PICTURES, _LEAST = 10, 3


class Seen(NamedTuple):
    """The landmarks found in an image, as columns of the map, and how many were expected."""

    stamp_ns: int
    columns: IndexArray
    expected: int


class FixSources:
    """
    The last images, from which poses were triangulated.

    Parameters
    ----------
    landmarks : int
        How many there are in the map.

    """

    def __init__(self, landmarks: int) -> None:
        self._landmarks = landmarks
        self._seen: deque[Seen] = deque(maxlen=_PICTURES)

    def add(self, seen: Seen) -> None:
        """Take note of an image."""
        self._seen.append(seen)

    def picture(self, stamp_ns: int) -> Seen | None:
        """Return the image of a time, if it is one of the last."""
        return next((seen for seen in self._seen if seen.stamp_ns == stamp_ns), None)

    def columns(self, stamp_ns: int) -> IndexArray:
        """Landmarks of a pose: those of its image; if too few, of all last ones; else all."""
        for own in (True, False):
            seen = [s.columns for s in self._seen if s.stamp_ns == stamp_ns or not own]
            found = np.unique(np.concatenate(seen)) if seen else ()
            if len(found) >= _LEAST:
                return np.asarray(found)
        return np.arange(self._landmarks)
