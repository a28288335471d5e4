"""
Landmarks among things that have changed.

Posters are exchanged, and shelves moved, as a whole. What is found where all around it is missing
may belong to what hangs there now: posters have the same heads, and frames stay.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from landmark_nav.types import FloatArray, LandmarkMap

__all__ = ['NeighbourConsistency']

# Neighbours are on the same wall (cosine of the angle between normals) and so near.
_NEAR_M, _SAME_WALL = 0.5, 0.9
# How far off is what is found then (RMS, in twenty simulated rooms with one image in five
# exchanged; elsewhere 1 mm).
_OFF_M = 0.01


class NeighbourConsistency:
    """Whether the neighbours of the landmarks of a map were found when they were looked for."""

    def __init__(self, landmark_map: LandmarkMap) -> None:
        count = len(landmark_map.landmarks)
        self._looked, self._found = np.zeros((2, count))
        pairs = np.empty((2, 0), dtype=np.intp)
        if count:
            pairs = cKDTree(landmark_map.positions).query_pairs(_NEAR_M, output_type='ndarray').T
            alike = np.sum(np.prod(landmark_map.normals[pairs], axis=0), axis=1)
            pairs = pairs[:, alike > _SAME_WALL]
        both = np.hstack([pairs, pairs[::-1]])
        self._near = coo_array((np.ones(both.shape[1]), tuple(both)), (count, count)).tocsr()

    def note(self, found: npt.NDArray[np.intp], missed: npt.NDArray[np.intp]) -> None:
        """Take note of what came of an image: columns of the map."""
        self._looked[found] = self._looked[missed] = 1.0
        self._found[found], self._found[missed] = 1.0, 0.0

    def variance_m2(self, columns: npt.NDArray[np.intp]) -> FloatArray:
        """How far off landmarks (n,) may be that were found: variance across the line of sight."""
        alone = (self._near @ self._looked > 0.0) & (self._near @ self._found == 0.0)
        return np.where(alone[columns], _OFF_M**2, 0.0)
