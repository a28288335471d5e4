"""
Which pairs of panoramas are compared: those that show most alike, and enough to place all sweeps.

Directions of the ways between v places in a plane determine their shape if 2 v - 3 of them are
independent (Laman's condition for rigid graphs; Whiteley, Contemporary Mathematics 197, 1996).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from landmark_nav.learning.relative_pose.features import Features, like_pairs
from landmark_nav.types import FloatArray

# Two panoramas.
Pair = tuple[int, int]
# Number of the most similar panoramas with which each is compared, and of the features that choose
# them.
_PARTNERS, _STRONGEST = 3, 1500
_DEPENDENT = 1e-6


def by_likeness(features: Sequence[Features]) -> tuple[list[Pair], set[Pair]]:
    """Return all pairs, those that show most alike first, and those of similar panoramas."""
    count = len(features)
    pairs = list(combinations(range(count), 2))
    if count <= _PARTNERS + 1:
        return pairs, set(pairs)
    strong = [Features(f.rays[:_STRONGEST], f.descriptors[:_STRONGEST]) for f in features]
    alike = np.full((count, count), -1)
    for i, j in pairs:
        matches = like_pairs(strong[i], strong[j]).distinct()[0]
        alike[i, j] = alike[j, i] = len(matches)
    best = np.argsort(-alike, 1, kind='stable')[:, :_PARTNERS]
    partners = {(min(k, int(j)), max(k, int(j))) for k, row in enumerate(best) for j in row}
    return sorted(pairs, key=lambda pair: -alike[pair]), partners


class Directions:
    """Independent directions between places, as they are for almost all places."""

    def __init__(self, count: int) -> None:
        self._places = np.random.default_rng(0).normal(size=(count, 2))
        self._basis = np.empty((0, 2 * count))

    def add(self, pair: Pair) -> None:
        """Add the direction of a pair."""
        if self.lack(pair):
            rest = self._rest(pair)
            self._basis = np.vstack([self._basis, rest / np.linalg.norm(rest)])

    def lack(self, pair: Pair) -> bool:
        """Whether the direction of a pair does not follow from the others."""
        return bool(np.linalg.norm(self._rest(pair)) > _DEPENDENT)

    def _rest(self, pair: Pair) -> FloatArray:
        """Constraint on the places by the direction of a pair, without what others constrain."""
        i, j = pair
        x, y = self._places[j] - self._places[i]
        row = np.zeros(self._places.shape)
        row[i], row[j] = (y, -x), (-y, x)
        flat = row.ravel()
        return np.asarray(flat - self._basis.T @ (self._basis @ flat))
