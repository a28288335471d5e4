"""Landmarks that speak for a place which nobody vouches for."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.types import LandmarkMap

__all__ = ['Witnesses']

# So many landmarks are no chance.
_LEAST = 3
# Cosines between the normals of landmarks on one wall, and on two.
_SAME_WALL, _OTHER_WALL = 0.9, 0.7


class Witnesses:
    """
    Whether a place that was found is told for sure: by landmarks of two walls.

    One wall may hang in another room as well, or one poster on another wall. A map that has only
    one wall cannot ask for more.

    Parameters
    ----------
    landmark_map : LandmarkMap
        Who may speak.
    vouched : bool
        Whether somebody else vouches for the place at first.

    """

    def __init__(self, landmark_map: LandmarkMap, vouched: bool = True) -> None:
        self._normals = landmark_map.normals[:, :2]
        self._heard = np.zeros(len(self._normals), dtype=np.bool_)
        self._vouched, self._was_wide = vouched, True

    def restart(self, vouched: bool) -> None:
        """Hear landmarks anew, of a pose that somebody vouches for, or not."""
        self._heard[:] = False
        self._vouched = vouched

    def note_width(self, wide: bool) -> None:
        """Begin anew where a pose grows wide: nobody vouches for where the robot went since."""
        if wide and not self._was_wide:
            self.restart(vouched=False)
        self._was_wide = wide

    def contradicted(self, again: bool) -> None:
        """
        Begin anew, as landmarks fit with a knock or a slip alone.

        If they do so `again` and again, a camera or a map is not as it is told: nobody vouches.
        """
        self.restart(self._vouched and not again)

    def found_by(self, columns: npt.NDArray[np.intp]) -> None:
        """Take note of landmarks by which a place was found: a picture more has to agree."""
        self._heard[columns] = True

    def hear(self, columns: npt.NDArray[np.intp]) -> None:
        """Take note of landmarks, by their places in the map, that agree with the pose."""
        if not self._vouched and len(columns):
            self._heard[columns] = True
            self._vouched = self._enough()

    @property
    def vouched(self) -> bool:
        """Whether the place is sure."""
        return self._vouched

    def _enough(self) -> bool:
        heard = self._normals[self._heard]
        if len(heard) < _LEAST:
            return False
        along = heard @ heard.T
        wall = heard[np.argmax((along > _SAME_WALL).sum(axis=1))]
        elsewhere = self._normals @ wall < _OTHER_WALL
        return bool(elsewhere[self._heard].sum() >= _LEAST or elsewhere.sum() < _LEAST)
