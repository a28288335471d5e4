"""
The pose of two panoramas with the most evidence, and how far what they show may mislead.

Things that were moved together between two sweeps agree with another pose than all that stayed,
and within the errors of a whole panorama both agree with a pose in between. So the pose is
searched among random samples of matches, by a likelihood in which a match has one of several
sigmas, from that of single features up, or is an outlier (MLESAC: Torr and Zisserman, Computer
Vision and Image Understanding 78(1), 2000). What hangs on one wall shares its errors: relief,
repeated texture, that it was moved. So sectors of azimuth, not matches, are weighted at random to
see how the pose changes (Bayesian bootstrap: Rubin, Annals of Statistics 9(1), 1981), about the
middle of all sweeps and alike in all pairs: they see the same walls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.arrays import BoolArray
from landmark_nav.geometry.se2 import cross
from landmark_nav.learning.least_squares import solve_positive
from landmark_nav.learning.relative_pose.epipolar import (
    DIRECTION_SIGMA_RAD,
    FEATURE_SIGMA_RAD,
    misses,
    RayPairs,
    residuals,
    RISE_SIGMA_M,
    TILT_SIGMA_RAD,
    turned,
)
from landmark_nav.learning.relative_pose.features import WIDE_BAND
from landmark_nav.types import FloatArray

# Number of sigmas that a match may have.
_SIGMAS = 3
# Number of samples, matches in each, and number of the best that are refined, in so many steps.
_SAMPLES, _SIZE, _REFINED, _STEPS = 1000, 6, 40, 8
# Share of inliers, in the first step and its least and greatest value.
_SHARE, _SHARES = 0.3, (0.02, 0.98)
# Relative sigma of the baseline, and sigma of the heading about the first pose: they limit the
# search.
_AROUND = 0.1
# Number of sectors of azimuth whose matches share errors (4 and 6 give much the same), and of
# draws.
_SECTORS, _DRAWS = 12, 48
# Greatest change of a state, in rad and m, that ends the steps; fewest matches that judge samples.
_CONVERGED, _SCREENED = 1e-5, 300
_NOTHING = 1e-12


@dataclass(frozen=True, eq=False)
class RigidSet:
    """
    State (6,) of the second view by the matches (m,) that agree with it, with their sigma.

    `loading` (6, q) are the errors of the state by what matches share, as factors with unit
    variance: those of sections of the room, the same for all pairs.
    """

    state: FloatArray
    agrees: BoolArray
    loading: FloatArray
    sigma_rad: float


def rigid_set(states: FloatArray, pairs: RayPairs) -> RigidSet:
    """
    Find the pose of the second view that matches support most.

    Parameters
    ----------
    states : ndarray, shape (v, 6)
        States of all views; that of `pairs.one` is fixed, that of `pairs.other` is the start.
    pairs : RayPairs
        Matches; there may be none.
    """
    rng, search = np.random.default_rng(0), _Search(states, pairs)
    every = np.ones(len(pairs.rays))
    tried = search.samples(rng)
    step = 1 + len(pairs.rays) // _SCREENED
    screen = _Search(states, pairs.chosen(np.arange(len(pairs.rays)) % step == 0))
    support = np.array([screen.gains(state, _SHARE).sum() for state in tried])
    first = np.argsort(-support, kind='stable')[:_REFINED]
    found = [search.refined(state, _SHARE, every) for state in tried[first]]
    gains = np.array([search.gains(*each) for each in found])
    best, share = found[int(np.argmax(gains.sum(axis=1)))]
    turns = _azimuths(states, pairs) * _SECTORS / (2.0 * np.pi)
    changes = []
    # All pairs of a room have the same draws: what a section of it misleads is common to them.
    rng = np.random.default_rng(_DRAWS)
    for _ in range(_DRAWS):
        sector = np.floor(turns + rng.uniform()).astype(int) % _SECTORS
        weight = rng.exponential(size=_SECTORS)[sector]
        likeliest = found[int(np.argmax(gains @ np.append(weight, 1.0)))]
        changes.append(search.refined(*likeliest, weight)[0] - best)
    off, _, inlier = search.inliers(best, share)
    inlier = inlier.sum(axis=1)
    variance = (inlier @ off**2 + DIRECTION_SIGMA_RAD**2) / (inlier.sum() + 1.0)
    loading = np.array(changes).T / np.sqrt(_DRAWS)
    return RigidSet(best, inlier > 0.5, loading, float(np.sqrt(variance)))


def _azimuths(states: FloatArray, pairs: RayPairs) -> FloatArray:
    """Azimuths (m,) in map of the points of matches from the middle of all views."""
    w, v = (
        turned(states[k], rays)
        for k, rays in ((pairs.one, pairs.rays), (pairs.other, pairs.other_rays))
    )
    here, way = states[pairs.one, :2], (states[pairs.other] - states[pairs.one])[:2]
    reach = cross(way, v) / (cross(w, v) + _NOTHING)
    x, y = (here + reach[:, None] * w[:, :2] - states[:, :2].mean(axis=0)).T
    return np.asarray(np.arctan2(y, x))


class _Search:
    """States of the second view of a pair, and their likelihood."""

    def __init__(self, states: FloatArray, pairs: RayPairs) -> None:
        self._pair = states[[pairs.one, pairs.other]]
        self._pairs = RayPairs(0, 1, pairs.rays, pairs.other_rays)
        self._noise_rad = DIRECTION_SIGMA_RAD
        self._sigmas = np.geomspace(FEATURE_SIGMA_RAD, self._noise_rad, _SIGMAS)
        length = float(np.hypot(*(self._pair[1] - self._pair[0])[:2]))
        tilt = np.sqrt(2.0) * TILT_SIGMA_RAD
        sigma = [_AROUND * length] * 2 + [_AROUND, RISE_SIGMA_M, tilt, tilt]
        self._information = np.diag(np.array(sigma) ** -2.0)
        self._prior = np.array([*self._pair[1, :3], self._pair[0, 3], 0.0, 0.0])

    def samples(self, rng: np.random.Generator) -> FloatArray:
        """States (n, 6) by random samples of matches."""
        off, jacobian, _ = misses(*self._at(self._pair[1]), self._noise_rad)
        size = min(_SIZE, len(off))
        samples = np.array([rng.permutation(len(off))[:size] for _ in range(_SAMPLES)])
        slope = jacobian[samples, 1]
        information = self._information + np.einsum('nki,nkj->nij', slope, slope)
        pull = np.einsum('nki,nk->ni', slope, off[samples])
        pull += self._information @ (self._pair[1] - self._prior)
        steps = np.linalg.solve(information, pull[..., None])[..., 0]
        return np.vstack([self._pair[1], self._pair[1] - steps])

    def gains(self, state: FloatArray, share: float) -> FloatArray:
        """Log-likelihood ratios (m + 1,) to chance of all matches, and that of the prior."""
        ratio = self._ratios(*residuals(*self._at(state), 1.0)).sum(axis=1)
        off = state - self._prior
        return np.append(np.log1p(share * (ratio - 1.0)), -0.5 * off @ self._information @ off)

    def inliers(
        self, state: FloatArray, share: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (m,), derivatives (m, 6), probabilities (m, s) of each sigma of a match."""
        off, jacobian, before = misses(*self._at(state), 1.0)
        ratio = share * self._ratios(off, before)
        return off, jacobian[:, 1], ratio / (1.0 - share + ratio.sum(axis=1, keepdims=True))

    def refined(
        self, state: FloatArray, share: float, weight: FloatArray
    ) -> tuple[FloatArray, float]:
        """Likeliest state near one, by weighted matches, and share of inliers."""
        for _ in range(_STEPS):
            off, slope, inlier = self.inliers(state, share)
            precision = weight * (inlier @ self._sigmas**-2.0)
            information = self._information + (slope.T * precision) @ slope
            pull = slope.T @ (precision * off) + self._information @ (state - self._prior)
            step = solve_positive(information, pull)
            state = state - step
            inside = weight @ inlier.sum(axis=1) / max(weight.sum(), _NOTHING)
            share = float(np.clip(inside, *_SHARES))
            if np.abs(step).max() < _CONVERGED:
                break
        return state, share

    def _ratios(self, off: FloatArray, before: BoolArray) -> FloatArray:
        """Likelihood ratios (m, s) to chance for each sigma: outliers are uniform in the band."""
        density = np.exp(-0.5 * np.square(off[:, None] / self._sigmas)) / self._sigmas
        band = 2.0 * WIDE_BAND * self._noise_rad
        return np.asarray(before[:, None] * density * band / (np.sqrt(2.0 * np.pi) * _SIGMAS))

    def _at(self, state: FloatArray) -> tuple[FloatArray, RayPairs]:
        return np.stack([self._pair[0], state]), self._pairs
