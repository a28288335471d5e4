"""Landmarks that confirm a place which was found from landmarks alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.types import LandmarkMap

__all__ = ['Witnesses']

# So many landmarks on a wall do not agree by chance.
_LEAST = 3
# Cosine of the angle between normals: above the first for one wall, below the second for two.
_SAME_WALL, _OTHER_WALL = 0.9, 0.7
# Landmarks so far apart are not of one poster or shelf, which may have been moved.
_APART_M = 2.0


class Witnesses:
    """
    Whether a place is sure: given by somebody, or confirmed by landmarks on two walls.

    Landmarks on one wall are not enough: the same poster may hang elsewhere, and another room may
    have the same wall. Where the map has landmarks on one wall only, those must do. A robot whose
    place was sure, and who only lost track of its way, is in the same room still: then two groups
    of landmarks on one wall, too far apart for one poster, will do as well.

    Parameters
    ----------
    landmark_map : LandmarkMap
        Its landmarks are the witnesses.
    vouched : bool
        Whether the place is sure at first, as somebody gave it.

    """

    def __init__(self, landmark_map: LandmarkMap, vouched: bool = True) -> None:
        self._normals = landmark_map.normals[:, :2]
        self._places = landmark_map.positions[:, :2]
        self._heard = np.zeros(len(self._normals), dtype=np.bool_)
        self._vouched, self._was_wide, self._same_room = vouched, True, False

    def restart(self, vouched: bool, same_room: bool = False) -> None:
        """
        Forget the landmarks heard.

        `vouched` says whether the place is sure without them, `same_room` whether the room is.
        """
        self._heard[:] = False
        self._vouched, self._same_room = vouched, same_room

    def note_width(self, wide: bool) -> None:
        """Begin anew, unsure, when the pose becomes wide."""
        if wide and not self._was_wide:
            self.restart(vouched=False, same_room=self._vouched or self._same_room)
        self._was_wide = wide

    def contradicted(self, again: bool) -> None:
        """
        Begin anew, as landmarks only fit if the camera was displaced or wheels slipped.

        If that happens `again` and again, the place is not sure any more: the camera or the map
        may be wrong.
        """
        self.restart(self._vouched and not again)

    def found_by(self, columns: npt.NDArray[np.intp]) -> None:
        """Count the landmarks from which a place was found; one more image has to agree."""
        self._heard[columns] = True

    def hear(self, columns: npt.NDArray[np.intp]) -> None:
        """Count landmarks (columns of the map) that agree with the pose."""
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
        if elsewhere[self._heard].sum() >= _LEAST or elsewhere.sum() < _LEAST:
            return True
        on_wall = self._places[self._heard][heard @ wall > _SAME_WALL]
        along_m = np.sort(on_wall @ [-wall[1], wall[0]])
        enough = self._same_room and len(along_m) >= 2 * _LEAST
        return enough and bool(along_m[-_LEAST] - along_m[_LEAST - 1] > _APART_M)
