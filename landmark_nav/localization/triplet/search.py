"""
The best triplets out of all, without looking at all.

The variance of a fix is at least what any two of its three landmarks allow (`geometry`),
so pairs that alone are worse than triplets already known are left out, and with them most
triplets; of the others the viewpoints are computed one after the other, and a triplet is given up
once what it has and what it must still get are too much. What is left out is provably worse: the
result is that of looking at all.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IndexArray
from landmark_nav.localization.triplet.geometry import PairTables, position_variance
from landmark_nav.types import FloatArray

__all__ = ['best_triplets', 'first_of_each', 'mean_variance']

# Pairs completed at a time: the arrays of their triplets stay in the cache.
_PAIRS = 1500
# Pairs that are completed in every way for a first bound.
_FIRST_PAIRS = 16
# Bounds are compared with so much room for rounding.
_ROUNDING = 1.0 + 1e-9
# Triplets that can't be combined have a score of infinity.
_NO_TRIPLET = 1e300


def mean_variance(tables: PairTables, triplets: IndexArray) -> FloatArray:
    """Position variance (t,) of triplets (t, 3), averaged over the tables' viewpoints (p,)."""
    i, j, k = np.ascontiguousarray(triplets.T)
    return np.asarray(position_variance(tables, i, j, k).mean(axis=0))


def best_triplets(
    tables: PairTables, factor: FloatArray, cost: FloatArray, count: int
) -> tuple[FloatArray, IndexArray]:
    """
    Triplets with the least score: variance times the landmarks' factors times the cost.

    Parameters
    ----------
    tables : PairTables
        Of n landmarks from viewpoints (p,), over which the variance is averaged.
    factor : ndarray, shape (n,)
        Of each landmark, at least 1.
    cost : ndarray, shape (n, n)
        Of each pair, at least 1, symmetric; a triplet costs the most of its pairs. Infinite for
        pairs that can't be combined.
    count : int
        How many are wanted.

    Returns
    -------
    scores : ndarray, shape (m,)
        Ascending; fewer than `count` if there are no more.
    triplets : ndarray of int, shape (m, 3)
        Each ascending.

    """
    with np.errstate(divide='ignore', invalid='ignore'):
        least = tables.error / tables.distance
    least[~np.isfinite(least)] = np.inf
    weight = np.outer(factor, factor) * factor.min(initial=np.inf) * cost
    bound = least.mean(axis=0) * weight
    search = _Search(tables, factor, cost, count)
    search.add(_around_best_pairs(bound).T)
    good = bound <= search.limit * _ROUNDING
    search.expect(least)
    for triplets in _triangles(good & np.isfinite(bound)):
        search.add(triplets)
    return search.scores, search.triplets


class _Search:
    """The best triplets so far, and the score that a new one must not exceed."""

    def __init__(
        self,
        tables: PairTables,
        factor: FloatArray,
        cost: FloatArray,
        count: int,
    ) -> None:
        self._points = [PairTables(*point) for point in zip(*tables, strict=True)]
        self._factor, self._cost, self._count = factor, cost, count
        self._to_come: FloatArray | None = None
        self.limit = _NO_TRIPLET
        self.scores: FloatArray = np.empty(0)
        self.triplets: IndexArray = np.empty((0, 3), dtype=np.intp)

    def expect(self, least: FloatArray) -> None:
        """Learn what each viewpoint adds at least, to any triplet with a pair, (p, n, n)."""
        self._to_come = np.cumsum(least[::-1], axis=0)[::-1] / len(least)

    def add(self, triplets: IndexArray) -> None:
        """Look at triplets (3, t)."""
        i, j, k = triplets
        weight = self._factor.take(i) * self._factor.take(j) * self._factor.take(k)
        weight *= _largest(self._cost, i, j, k)
        total = np.zeros(len(i))
        for place, point in enumerate([None, *self._points]):
            if point is not None:
                total += position_variance(point, i, j, k) / len(self._points)
            lower = total
            if self._to_come is not None and place < len(self._points):
                lower = total + _largest(self._to_come[place], i, j, k)
            with np.errstate(invalid='ignore'):
                good = np.flatnonzero(lower * weight <= self.limit * _ROUNDING)
            i, j, k, total, weight = (a.take(good) for a in (i, j, k, total, weight))
        found = np.sort(np.stack([i, j, k], -1), axis=1)
        scores, triplets = total * weight, np.concatenate([self.triplets, found])
        finite = np.isfinite(scores)
        scores = np.concatenate([self.scores, scores])
        finite = np.concatenate([np.ones(len(self.scores), np.bool_), finite])
        scores, triplets = scores[finite], triplets[finite]
        once = first_of_each(triplets)
        best = once[np.argsort(scores[once], kind='stable')[: self._count]]
        self.scores, self.triplets = scores[best], triplets[best]
        if len(best) == self._count:
            self.limit = float(self.scores[-1])


def first_of_each(triplets: IndexArray) -> IndexArray:
    """Places where each of the triplets (t, 3) of a list comes first, in ascending order."""
    n = triplets.max(initial=0) + 1
    return np.unique(triplets @ np.array([n * n, n, 1]), return_index=True)[1]


def _largest(table: FloatArray, i: IndexArray, j: IndexArray, k: IndexArray) -> FloatArray:
    n, flat = len(table), table.reshape(-1)
    largest = np.maximum(flat.take(n * i + j), flat.take(n * i + k))
    return np.asarray(np.maximum(largest, flat.take(n * j + k)))


def _around_best_pairs(bound: FloatArray) -> IndexArray:
    """Triplets (t, 3) of the best pairs with every third."""
    n = len(bound)
    once = np.where(np.tri(n, dtype=np.bool_), np.inf, bound)
    count = min(_FIRST_PAIRS, once.size - 1)
    best = np.argpartition(once.reshape(-1), count)[:count]
    first, second = np.divmod(best, n)
    pairs = np.stack([first, second], -1)[first < second]
    third = np.tile(np.arange(n), len(pairs))
    triplets = np.column_stack([np.repeat(pairs, n, axis=0), third])
    return np.asarray(triplets[(third != triplets[:, 0]) & (third != triplets[:, 1])])


def _triangles(good: npt.NDArray[np.bool_]) -> Iterator[IndexArray]:
    """Batches (3, t) of triplets whose three pairs are all `good` (n, n)."""
    # Those with few partners first: each landmark then has few later ones.
    order = np.argsort(good.sum(axis=0), kind='stable')
    later = np.triu(good[np.ix_(order, order)], 1)
    first, second = np.nonzero(later)
    for start in range(0, len(first), _PAIRS):
        i, j = first[start : start + _PAIRS], second[start : start + _PAIRS]
        # A flat search and a division are quicker than a search by row and column.
        found = np.flatnonzero(later[i] & later[j])
        pair = found // len(order)
        third = found - pair * len(order)
        if len(found):
            yield np.stack([order[i[pair]], order[j[pair]], order[third]])
