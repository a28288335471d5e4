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


class Witnesses:
    """
    Whether a place is sure: given by somebody, or confirmed by landmarks on two walls.

    Landmarks on one wall are not enough: the same poster may hang elsewhere. Where the map has
    landmarks on one wall only, those must do.

    Parameters
    ----------
    landmark_map : LandmarkMap
        Its landmarks are the witnesses.
    vouched : bool
        Whether the place is sure at first, as somebody gave it.

    """

    def __init__(self, landmark_map: LandmarkMap, vouched: bool = True) -> None:
        self._normals = landmark_map.normals[:, :2]
        self._heard = np.zeros(len(self._normals), dtype=np.bool_)
        self._vouched, self._was_wide = vouched, True

    def restart(self, vouched: bool) -> None:
        """Forget the landmarks heard; `vouched` says whether the place is sure without them."""
        self._heard[:] = False
        self._vouched = vouched

    def note_width(self, wide: bool) -> None:
        """Begin anew, unsure, when the pose becomes wide."""
        if wide and not self._was_wide:
            self.restart(vouched=False)
        self._was_wide = wide

    def contradicted(self, again: bool) -> None:
        """
        Begin anew, as landmarks only fit if the camera was knocked or wheels slipped.

        If that happens `again` and again, the place is not sure any more: the camera or the map
        may be wrong.
        """
        self.restart(self._vouched and not again)

    def found_by(self, columns: npt.NDArray[np.intp]) -> None:
        """Count the landmarks from which a place was found; one more picture has to agree."""
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
        return bool(elsewhere[self._heard].sum() >= _LEAST or elsewhere.sum() < _LEAST)
