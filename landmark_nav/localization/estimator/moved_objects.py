"""
Objects that were moved since learning.

The displacement of an object on the floor is in the state. It is none or, with a small prior
probability, that of a moved object. A Gaussian prior stands for this mixture, and is exchanged as
the evidence of all images changes.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy.special import expit, logsumexp

from landmark_nav.arrays import IndexArray
from landmark_nav.localization.estimator.factors import STATES
from landmark_nav.localization.estimator.state import information_of, State
from landmark_nav.types import FloatArray

# Variance of the displacement of an object that was not moved, m^2: not 0, so that it can be
# exchanged.
STILL_M2 = 1e-4**2
# Most objects of which all combinations are compared, and the share from which on they are.
_MOST_TOGETHER, _POSSIBLE = 6, 1e-3
# Relative change of an inverse covariance that is worth an exchange.
_SAME = 0.2
# Sigmas from which on a displacement is clear.
_CLEARLY = 3.0


def _log_evidence(
    mean: FloatArray, covariance: FloatArray, before: FloatArray, after: FloatArray
) -> FloatArray:
    """
    Log evidence (...,) of all images with another prior, over that with the one before.

    `mean` (..., n) and `covariance` (..., n, n) are the estimates with the prior before; `before`
    and `after` (..., n, n) are inverse covariances of the priors, `before` nowhere singular.
    """
    scaled = np.eye(mean.shape[-1]) + (after - before) @ covariance
    pull = np.linalg.solve(scaled, ((after - before) @ mean[..., None]))[..., 0]
    ratio = np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]
    return np.asarray(0.5 * (ratio - np.linalg.slogdet(scaled)[1] - np.sum(mean * pull, axis=-1)))


def _diagonal(blocks: FloatArray) -> FloatArray:
    """Matrix (..., 2 n, 2 n) with blocks (..., n, 2, 2) on its diagonal."""
    *shape, count, size, _ = blocks.shape
    out = np.zeros((*shape, count, size, count, size))
    each = np.arange(count)
    # The indexed axes come first.
    out[..., each, :, each, :] = np.moveaxis(blocks, -3, 0)
    return out.reshape(*shape, count * size, count * size)


def exchanged(state: State, objects: IndexArray, information: FloatArray) -> tuple[State, float]:
    """
    Return the state as if displacements of objects had had another prior from the beginning.

    Exact for a linear estimator: an image with which an object was taken for still is taken back.

    Parameters
    ----------
    objects : ndarray of int, shape (m,)
        Objects in the state.
    information : ndarray, shape (m, 2, 2)
        Inverse covariances of their displacements along x and y, 1/m^2.

    Returns
    -------
    state : State
    log_evidence : float
        Log of the ratio of the densities of all images so far, new over old.
    """
    places = state.displacements(objects).ravel()
    which = np.searchsorted(state.objects, objects)
    before, new = _diagonal(state.still[which]), _diagonal(information)
    mean, covariance = state.mean[places], state.covariance[np.ix_(places, places)]
    evidence = float(_log_evidence(mean, covariance, before, new))
    added = new - before
    columns = state.covariance[:, places]
    # The new prior is a measurement that no displacement is there, or takes one back.
    gain = np.linalg.solve(np.eye(len(places)) + added @ covariance, added)
    gain = columns @ (0.5 * (gain + gain.T))
    after = state.covariance - gain @ columns.T
    acted = columns[:STATES].T @ information_of(state.covariance[:STATES, :STATES])
    left = np.eye(STATES) - gain[:STATES] @ acted
    still = state.still.copy()
    still[which] = information
    other = replace(
        state,
        mean=state.mean - gain @ mean,
        covariance=0.5 * (after + after.T),
        by_noise=left @ state.by_noise @ left.T,
        still=still,
    )
    return other.corrected_from(state), evidence


def isotropic(count: int, variance_m2: float) -> FloatArray:
    """Inverse covariances (count, 2, 2) of displacements."""
    return np.tile(np.eye(2) / variance_m2, (count, 1, 1))


def _variances_m2(state: State) -> FloatArray:
    """Mean of the prior variances of each displacement (k,) along x and y."""
    return np.asarray(np.linalg.inv(state.still).trace(axis1=1, axis2=2) / 2.0)


def weighed(state: State, log_odds: float, moved_m2: float) -> State:
    """
    Return the state with the priors of the mixtures, by all images so far.

    With the prior of a displacement, its estimate has the covariance of the mixture of both cases.

    Parameters
    ----------
    log_odds : float
        Those that an object was moved.
    moved_m2 : float
        Variance of a moved object along x and y.
    """
    count = len(state.objects)
    if not count:
        return state
    places = state.displacements(state.objects)
    means = state.mean[places]
    covariances = state.covariance[places[:, :, None], places[:, None]]
    open_, closed = isotropic(1, STILL_M2 + moved_m2)[0], isotropic(1, STILL_M2)[0]
    share = expit(
        log_odds
        + _log_evidence(means, covariances, state.still, open_)
        - _log_evidence(means, covariances, state.still, closed)
    )
    # What one object explains, another may explain as well.
    opened = _variances_m2(state) / moved_m2
    possible = np.flatnonzero((share > _POSSIBLE) | (opened > _POSSIBLE))
    together = possible[np.argsort(-np.maximum(share, opened)[possible])][:_MOST_TOGETHER]
    if len(together) > 1:
        moved = np.array([*product((False, True), repeat=len(together))])
        joint = places[together].ravel()
        evidence = _log_evidence(
            state.mean[joint],
            state.covariance[np.ix_(joint, joint)],
            _diagonal(state.still[together]),
            _diagonal(np.where(moved[..., None, None], open_, closed)),
        )
        odds = evidence + log_odds * moved.sum(axis=1)
        share[together] = np.exp(odds - logsumexp(odds)) @ moved
    precise = np.linalg.inv(covariances)
    shown = precise - state.still
    spread = np.linalg.inv(shown + open_)
    off = (spread @ precise @ means[..., None])[..., 0]
    part = share[:, None, None]
    mixed = part * spread + (1.0 - part) * np.linalg.inv(shown + closed)
    mixed += part * (1.0 - part) * off[:, :, None] * off[:, None]
    values, vectors = np.linalg.eigh(np.linalg.inv(mixed) - shown)
    values = np.clip(values, open_[0, 0], closed[0, 0])
    still = (vectors * values[:, None]) @ vectors.swapaxes(1, 2)
    size = np.linalg.norm(still, axis=(1, 2))
    changed = np.linalg.norm(still - state.still, axis=(1, 2)) > _SAME * size
    if not changed.any():
        return state
    return exchanged(state, state.objects[changed], still[changed])[0]


def moved(state: State, moved_m2: float) -> npt.NDArray[np.bool_]:
    """Which objects (k,) of a state were more likely moved than not, and are clearly displaced."""
    places = state.displacements(state.objects)
    covariances = state.covariance[places[:, :, None], places[:, None]]
    off = state.mean[places][..., None]
    squares = (off.swapaxes(1, 2) @ np.linalg.solve(covariances, off))[:, 0, 0]
    return np.asarray((_variances_m2(state) > 0.5 * moved_m2) & (squares > _CLEARLY**2))
