"""
What three landmarks are worth: triplets that one view can hold, and their predicted variance.

Everything works on the gradients ``h_k`` of the bearings, the landmarks' inverse points turned by
a right angle: with ``det = (h1 - h3) x (h2 - h3)``, twice the area of their triangle, a bearing
error moves the fix by ``dp/db1 = J (h2 - h3) / det`` and cyclic (J turns by -90 degrees). So the
danger circle is where the inverse points lie on a line.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.localization.triangulation_model import bearing_gradients
from landmark_nav.types import FloatArray, LandmarkMap

__all__ = ['Sightings', 'ViewTriplets', 'position_variance', 'sightings', 'triplets_in_one_view']

IndexArray = npt.NDArray[np.intp]


class Sightings(NamedTuple):
    """
    What n bearings would be worth from viewpoints (...).

    `gradient` (..., n, 2) by the viewpoint's x and y, `variance` (..., n) of their own and
    `shared` (..., n, m) by the map's unit-variance common factors.
    """

    gradient: FloatArray
    variance: FloatArray
    shared: FloatArray


class ViewTriplets(NamedTuple):
    """Triplets (m, 3) that fit one view, and the pan (m,) that sees each best."""

    triplets: IndexArray
    pan_rad: FloatArray


def sightings(
    viewpoints: FloatArray, landmark_map: LandmarkMap, index: IndexArray, bearing_sigma: float
) -> Sightings:
    """Return what the landmarks `index` (n,) are worth from viewpoints (..., 2) in map."""
    gradient = bearing_gradients(viewpoints, landmark_map.positions[index, :2])
    loading = np.array([landmark_map.landmarks[k].shared_loading[:2] for k in index])
    own = landmark_map.covariances[index, :2, :2] - loading @ loading.swapaxes(-1, -2)
    variance = np.einsum('...ni,nij,...nj->...n', gradient, own, gradient)
    shared = -np.einsum('...ni,nim->...nm', gradient, loading)
    return Sightings(gradient, bearing_sigma**2 + np.maximum(variance, 0.0), shared)


def position_variance(seen: Sightings, triplets: IndexArray) -> FloatArray:
    """Trace (..., t) of the position covariance of fixes from triplets (t, 3); inf if none."""
    h1, h2, h3 = np.moveaxis(seen.gradient[..., triplets, :], -2, 0)
    sides = np.stack([h2 - h3, h3 - h1, h1 - h2], -2)
    det = sides[..., 0, 0] * sides[..., 1, 1] - sides[..., 0, 1] * sides[..., 1, 0]
    own = np.sum(seen.variance[..., triplets] * np.sum(sides * sides, -1), -1)
    # |J v| = |v|, so the turn J is left out of the sum over the common factors too.
    common = np.swapaxes(sides, -1, -2) @ seen.shared[..., triplets, :]
    with np.errstate(divide='ignore', invalid='ignore'):
        trace = (own + np.sum(common * common, (-1, -2))) / det**2
    return np.where(np.isfinite(trace), trace, np.inf)


def triplets_in_one_view(
    azimuth_rad: FloatArray, reach_rad: FloatArray, limits_rad: tuple[float, float]
) -> ViewTriplets:
    """
    All triplets that some pan within the limits sees together.

    Parameters
    ----------
    azimuth_rad : ndarray, shape (n,)
        Of the landmarks, in the frame of the pan axis.
    reach_rad : ndarray, shape (n,)
        How far the pan may be off a landmark's azimuth and still hold it whole, less than pi / 2.
    limits_rad : tuple of float
        Least and greatest pan.

    """
    n = len(azimuth_rad)
    ahead = np.mod(azimuth_rad[None] - azimuth_rad[:, None], 2.0 * np.pi)
    # Equal azimuths: the order of the indices decides who comes first.
    ahead[(ahead == 0.0) & (np.arange(n)[:, None] > np.arange(n))] = np.inf
    together = ahead <= reach_rad[None] + reach_rad[:, None]
    np.fill_diagonal(together, False)
    first, other = np.nonzero(together)
    order = np.lexsort((ahead[first, other], first))
    first, other = first[order], other[order]

    # A triplet is two pairs with the same first landmark, counter-clockwise.
    end = np.searchsorted(first, first, side='right')
    partners = end - np.arange(len(first)) - 1
    pair = np.repeat(np.arange(len(first)), partners)
    rank = np.arange(len(pair)) - np.repeat(np.cumsum(partners) - partners, partners)
    index = np.stack([first[pair], other[pair], other[pair + 1 + rank]], -1)

    relative = np.stack(
        [np.zeros(len(index)), ahead[index[:, 0], index[:, 1]], ahead[index[:, 0], index[:, 2]]],
        -1,
    )
    lower = np.max(relative - reach_rad[index], axis=-1)
    upper = np.min(relative + reach_rad[index], axis=-1)
    fits = lower <= upper
    index, lower, upper = index[fits], lower[fits], upper[fits]
    return _within_limits(
        index, azimuth_rad[index[:, 0]] + lower, azimuth_rad[index[:, 0]] + upper, limits_rad
    )


def _within_limits(
    index: IndexArray, lower: FloatArray, upper: FloatArray, limits_rad: tuple[float, float]
) -> ViewTriplets:
    """Clip the middle of the pans [lower, upper] to the limits, in whichever turn fits best."""
    turns = 2.0 * np.pi * np.arange(-2, 3)[:, None]
    middle = 0.5 * (lower + upper) + turns
    pan = np.clip(middle, *limits_rad)
    off = np.abs(pan - middle)
    best = np.argmin(off, axis=0)[None]
    pan = np.take_along_axis(pan, best, 0)[0]
    off = np.take_along_axis(off, best, 0)[0]
    fits = off <= 0.5 * (upper - lower)
    return ViewTriplets(index[fits], pan[fits])
