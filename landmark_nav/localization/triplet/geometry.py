"""
What three landmarks are worth: the predicted covariance of a fix, for any number of triplets.

Everything works on the gradients ``h_k`` of the bearings, the landmarks' inverse points turned by
a right angle. The difference of two bearings does not depend on the heading:
``(h_i - h_j) . dp = e_i - e_j``. So the position's covariance follows from two tables over pairs
of landmarks, the variance E of ``e_i - e_j`` and the squared distance D of ``h_i`` and ``h_j``:
E / D is the position's variance along ``h_i - h_j``, whatever the third landmark, and a lower
bound of the trace. The danger circle is where three inverse points lie on a line.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.localization.triangulation.model import bearing_gradients
from landmark_nav.types import FloatArray, LandmarkMap

__all__ = ['PairTables', 'fix_covariances', 'pair_tables', 'position_variance']


class PairTables(NamedTuple):
    """
    What pairs out of n landmarks are worth from viewpoints (...).

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
    """Return what pairs of the landmarks `index` (n,) are worth from viewpoints (..., 2)."""
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
    # One index instead of two: twice as quick.
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

    Of the pose of the pan axis at `viewpoint` (2,), with the orientation of the base.
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
    Gradient (..., n, 2) of n bearings and their errors.

    Those are variances (..., n) of their own and loadings (..., n, m) of the map's unit-variance
    common factors.
    """
    gradient = bearing_gradients(viewpoints, landmark_map.positions[index, :2])
    loading = landmark_map.shared_loadings[index, :2]
    own = landmark_map.covariances[index, :2, :2] - loading @ loading.swapaxes(-1, -2)
    variance = ((gradient[..., None, :] @ own)[..., 0, :] * gradient).sum(axis=-1)
    shared = -(gradient[..., None, :] @ loading)[..., 0, :]
    return gradient, bearing_sigma**2 + np.maximum(variance, 0.0), shared
