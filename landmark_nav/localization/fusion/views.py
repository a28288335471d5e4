"""What the last images showed of the landmarks that should have been in them."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from landmark_nav.arrays import BoolArray, FloatArray, IndexArray

__all__ = ['AGREE', 'FOUND_SHARE', 'Views']

# An image confirms the pose if it shows so many landmarks and this share of those expected.
AGREE, FOUND_SHARE = 3, 0.4
# The pose is contradicted if no more than this share of the expected landmarks are found, of so
# many at least. Those missed must spread over more than this extent: a single poster may have been
# exchanged.
_MISSING_SHARE, _MISSING_EXPECTED, _MISSING_EXTENT_M = 0.15, 10, 1.5
# Landmarks are familiar once an image has shown them at this pose. Familiar ones are missed after
# the first of these times. The others may hang on a wall whose posters were exchanged: they count
# only if no image has confirmed the pose for the second time, or for the third if as many are
# familiar as it takes to contradict the pose.
_FAMILIAR_S, _ALL_S, _OUTWEIGHED_S = 1.4, 4.0, 15.0
# One image that shows nothing may be blurred; so many in a row are not.
_BLINDED = 2
# The images must span this share of those times.
_LASTING_SHARE = 0.6
# Share of the bearings that may contradict the others; with right poses it is 0.06 at most over
# five images.
_ELSEWHERE_SHARE = 0.15


class _View(NamedTuple):
    """
    What an image showed.

    `found` landmarks, which may confirm the pose; `elsewhere` is how many bearings contradict the
    others; `places` (n, 3) are those of the missed landmarks, `familiar` (n,) says which of them
    were seen before.
    """

    stamp_ns: int
    found: int
    confirms: bool
    elsewhere: int
    places: FloatArray
    familiar: BoolArray


class Views:
    """Whether images contradict the pose by landmarks that are missing or lie elsewhere."""

    def __init__(self) -> None:
        self._views: deque[_View] = deque()
        self._familiar: set[int] = set()
        self._confirmed_ns = 0

    def clear(self) -> None:
        """Forget the images and which landmarks are familiar."""
        self._views.clear()
        self._familiar.clear()

    def add(
        self,
        stamp_ns: int,
        found: IndexArray,
        missed: IndexArray,
        places: FloatArray,
        elsewhere: int,
    ) -> None:
        """Take note of an image: landmarks that agree with the pose, and those not found."""
        confirms = len(found) >= max(AGREE, FOUND_SHARE * (len(found) + len(missed)))
        if confirms:
            self._confirmed_ns = stamp_ns
            self._familiar.update(found.tolist())
        known = self._familiar
        familiar = np.array([not known or k in known for k in missed.tolist()], dtype=np.bool_)
        self._views.append(_View(stamp_ns, len(found), confirms, elsewhere, places, familiar))
        while abs(stamp_ns - self._views[0].stamp_ns) * 1e-9 > _ALL_S:
            self._views.popleft()

    @property
    def blind_since_ns(self) -> int | None:
        """When the last images began, if none of them shows any familiar landmark; else None."""
        last = list(self._views)[-_BLINDED:]
        blind = [not view.found and np.count_nonzero(view.familiar) >= AGREE for view in last]
        blinded = self._familiar and len(last) == _BLINDED and all(blind)
        return last[0].stamp_ns if blinded else None

    def elsewhere(self) -> str:
        """How many bearings contradict the others, in words; empty if few do."""
        views = self._within(_FAMILIAR_S)
        elsewhere = sum(view.elsewhere for view in views)
        seen = elsewhere + sum(view.found for view in views)
        if elsewhere < AGREE or elsewhere <= _ELSEWHERE_SHARE * seen:
            return ''
        return f'{elsewhere} of {seen}, the pose or the calibration may be wrong'

    def missing(self) -> str:
        """
        How few of the expected landmarks were found, in words; empty if they are enough.

        With a wrong pose hardly any landmark is found for as long as it is wrong; a covered
        landmark or an exchanged poster leaves the others to be found.
        """
        if few := self._missing(_FAMILIAR_S, unfamiliar=False):
            return few
        patience_s = _OUTWEIGHED_S if len(self._familiar) >= _MISSING_EXPECTED else _ALL_S
        waited_s = 1e-9 * abs(self._views[-1].stamp_ns - self._confirmed_ns)
        if self._familiar and waited_s <= patience_s:
            return ''
        return self._missing(_ALL_S, unfamiliar=True)

    def _missing(self, seconds: float, unfamiliar: bool) -> str:
        views = self._within(seconds)
        places = np.concatenate([view.places[view.familiar | unfamiliar] for view in views])
        found = sum(view.found for view in views)
        expected = found + len(places)
        lasts = (views[-1].stamp_ns - views[0].stamp_ns) * 1e-9 >= _LASTING_SHARE * seconds
        if not lasts or expected < _MISSING_EXPECTED or found > _MISSING_SHARE * expected:
            return ''
        if np.linalg.norm(np.ptp(places[:, :2], axis=0)) <= _MISSING_EXTENT_M:
            return ''
        which = f'{found} of {expected} landmarks that should be in the last {len(views)} images'
        return f'{which} were found'

    def _within(self, seconds: float) -> list[_View]:
        newest_ns = self._views[-1].stamp_ns
        return [view for view in self._views if abs(newest_ns - view.stamp_ns) * 1e-9 <= seconds]
