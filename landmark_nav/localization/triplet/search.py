"""
Branch and bound over triplets of landmarks: the best ones, without computing all of them.

Any two of the three landmarks bound the variance of a fix from below. Pairs whose bound is worse
than the best triplets so far are left out, and with them most triplets. The others are computed
viewpoint by viewpoint, and dropped once their sum and the bound of the remaining viewpoints exceed
the limit. The result is the same as that of a full search.

The predicted covariance is computed from the gradients ``h_k`` of the bearings: the landmarks'
inverse points, rotated by a right angle. The difference of two bearings does not depend on the
heading:
``(h_i - h_j) . dp = e_i - e_j``. So the position's covariance follows from two tables over pairs
of landmarks, the variance E of ``e_i - e_j`` and the squared distance D of ``h_i`` and ``h_j``:
E / D is the position's variance along ``h_i - h_j``, whatever the third landmark, and a lower
bound of the trace. The danger circle is where three inverse points lie on a line.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IndexArray
from landmark_nav.localization.triangulation.model import bearing_gradients
from landmark_nav.types import FloatArray, LandmarkMap


class PairTables(NamedTuple):
    """
    Information of pairs out of n landmarks, seen from viewpoints (...).

    `gradient` (..., 2, n) of the bearings by x and y of the viewpoint; `error` (..., n, n) is the
    variance of the difference of two bearings, `distance` (..., n, n) the squared distance of
    their gradients.
    """

    gradient: FloatArray
    error: FloatArray
    distance: FloatArray


def pair_tables(
    viewpoints: FloatArray, landmark_map: LandmarkMap, index: IndexArray, bearing_sigma: float
) -> PairTables:
    """Return the information of pairs of the landmarks `index` (n,) from viewpoints (..., 2)."""
    gradient, own, shared = _bearing_models(viewpoints, landmark_map, index, bearing_sigma)
    common = shared @ np.swapaxes(shared, -1, -2)
    total = own + np.einsum('...ii->...i', common)
    error = total[..., :, None] + total[..., None, :] - 2.0 * common
    x, y = gradient[..., 0], gradient[..., 1]
    distance = (x[..., :, None] - x[..., None, :]) ** 2
    distance += (y[..., :, None] - y[..., None, :]) ** 2
    return PairTables(np.ascontiguousarray(np.swapaxes(gradient, -1, -2)), error, distance)


def position_variance(
    tables: PairTables, i: IndexArray, j: IndexArray, k: IndexArray
) -> FloatArray:
    """Trace (..., t) of the position covariance of fixes from landmarks i, j, k; inf if none."""
    n = tables.error.shape[-1]
    # One flat index instead of two is twice as fast.
    pairs = (n * i + j, n * i + k, n * j + k)
    error_ij, error_ik, error_jk = (_taken(tables.error, pair) for pair in pairs)
    side_ij, side_ik, side_jk = (_taken(tables.distance, pair) for pair in pairs)
    # Twice the covariance of the two differences, and twice the sides' inner product.
    mixed = (error_ij + error_ik - error_jk) * (side_ij + side_ik - side_jk)
    x, y = tables.gradient[..., 0, :], tables.gradient[..., 1, :]
    first_x, first_y = x.take(i, axis=-1), y.take(i, axis=-1)
    area = (x.take(j, axis=-1) - first_x) * (y.take(k, axis=-1) - first_y)
    area -= (y.take(j, axis=-1) - first_y) * (x.take(k, axis=-1) - first_x)
    with np.errstate(divide='ignore', invalid='ignore'):
        trace = (error_ij * side_ik + error_ik * side_ij - 0.5 * mixed) / area**2
    return np.where(np.isfinite(trace), trace, np.inf)


def _taken(table: FloatArray, pair: IndexArray) -> FloatArray:
    return table.reshape(*table.shape[:-2], -1).take(pair, axis=-1)


def fix_covariances(
    viewpoint: FloatArray, landmark_map: LandmarkMap, triplets: IndexArray, bearing_sigma: float
) -> FloatArray:
    """
    First-order covariances (t, 3, 3) of x, y and heading of fixes from triplets (t, 3).

    The pose is that of the pan axis at `viewpoint` (2,), with the orientation of the base.
    """
    used, place = np.unique(triplets, return_inverse=True)
    gradient, own, shared = _bearing_models(viewpoint, landmark_map, used, bearing_sigma)
    place = place.reshape(triplets.shape)
    noise = shared[place] @ np.swapaxes(shared[place], -1, -2)
    noise[:, range(3), range(3)] += own[place]
    heading = np.full((*triplets.shape, 1), -1.0)
    inverse = np.linalg.inv(np.concatenate([gradient[place], heading], -1))
    return np.asarray(inverse @ noise @ np.swapaxes(inverse, -1, -2))


def _bearing_models(
    viewpoints: FloatArray, landmark_map: LandmarkMap, index: IndexArray, bearing_sigma: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Gradients (..., n, 2) of n bearings, their own variances (..., n), and loadings (..., n, m).

    Loadings are of the map's shared factors, which have unit variance.
    """
    gradient = bearing_gradients(viewpoints, landmark_map.positions[index, :2])
    loading = landmark_map.shared_loadings[index, :2]
    own = landmark_map.covariances[index, :2, :2] - loading @ loading.swapaxes(-1, -2)
    variance = ((gradient[..., None, :] @ own)[..., 0, :] * gradient).sum(axis=-1)
    shared = -(gradient[..., None, :] @ loading)[..., 0, :]
    return gradient, bearing_sigma**2 + np.maximum(variance, 0.0), shared


# Pairs extended to triplets at a time: the arrays stay in the cache.
_PAIRS = 1500
# Pairs combined with every third landmark for a first bound.
_FIRST_PAIRS = 16
# Margin for rounding when bounds are compared.
_ROUNDING = 1.0 + 1e-9
# Limit before any triplet is known: all finite scores are below.
_NO_TRIPLET = 1e300


def mean_variance(tables: PairTables, triplets: IndexArray) -> FloatArray:
    """Position variance (t,) of triplets (t, 3), averaged over the tables' viewpoints (p,)."""
    i, j, k = np.ascontiguousarray(triplets.T)
    return np.asarray(position_variance(tables, i, j, k).mean(axis=0))


def best_triplets(
    tables: PairTables, factor: FloatArray, cost: FloatArray, count: int
) -> tuple[FloatArray, IndexArray]:
    """
    Triplets with the lowest score: variance times the landmarks' factors times the cost.

    Parameters
    ----------
    tables : PairTables
        Of n landmarks from viewpoints (p,), over which the variance is averaged.
    factor : ndarray, shape (n,)
        Factor of each landmark, at least 1.
    cost : ndarray, shape (n, n)
        Cost of each pair, at least 1, symmetric; infinite for pairs that can't be combined. The
        cost of a triplet is the largest of its pairs.

    Returns
    -------
    scores : ndarray, shape (m,)
        Ascending; fewer than `count` if there are no more.
    triplets : ndarray of int, shape (m, 3)
        Indices of each, ascending.
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
    """The best triplets so far, and the highest score that a new one may have."""

    def __init__(
        self, tables: PairTables, factor: FloatArray, cost: FloatArray, count: int
    ) -> None:
        self._points = [PairTables(*point) for point in zip(*tables, strict=True)]
        self._factor, self._cost, self._count = factor, cost, count
        self._to_come: FloatArray | None = None
        self.limit = _NO_TRIPLET
        self.scores: FloatArray = np.empty(0)
        self.triplets: IndexArray = np.empty((0, 3), dtype=np.intp)

    def expect(self, least: FloatArray) -> None:
        """Set the lower bound that each viewpoint adds to triplets with a pair, (p, n, n)."""
        self._to_come = np.cumsum(least[::-1], axis=0)[::-1] / len(least)

    def add(self, triplets: IndexArray) -> None:
        """Compute triplets (3, t) and keep the best."""
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
        finite = np.isfinite(total * weight)
        scores = np.concatenate([self.scores, (total * weight)[finite]])
        found = np.sort(np.stack([i, j, k], -1)[finite], axis=1)
        triplets = np.concatenate([self.triplets, found])
        once = first_of_each(triplets)
        best = once[np.argsort(scores[once], kind='stable')[: self._count]]
        self.scores, self.triplets = scores[best], triplets[best]
        if len(best) == self._count:
            self.limit = float(self.scores[-1])


def first_of_each(triplets: IndexArray) -> IndexArray:
    """Index of the first occurrence of each distinct triplet out of (t, 3)."""
    n = triplets.max(initial=0) + 1
    return np.unique(triplets @ np.array([n * n, n, 1]), return_index=True)[1]


def _largest(table: FloatArray, i: IndexArray, j: IndexArray, k: IndexArray) -> FloatArray:
    n, flat = len(table), table.reshape(-1)
    largest = np.maximum(flat.take(n * i + j), flat.take(n * i + k))
    return np.asarray(np.maximum(largest, flat.take(n * j + k)))


def _around_best_pairs(bound: FloatArray) -> IndexArray:
    """Triplets (t, 3) of the best pairs with every third landmark."""
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
    # Landmarks with few partners come first: each then has few later partners.
    order = np.argsort(good.sum(axis=0), kind='stable')
    later = np.triu(good[np.ix_(order, order)], 1)
    first, second = np.nonzero(later)
    for start in range(0, len(first), _PAIRS):
        i, j = first[start : start + _PAIRS], second[start : start + _PAIRS]
        # A flat search and a division are faster than a search by row and column.
        found = np.flatnonzero(later[i] & later[j])
        pair = found // len(order)
        third = found - pair * len(order)
        if len(found):
            yield np.stack([order[i[pair]], order[j[pair]], order[third]])
