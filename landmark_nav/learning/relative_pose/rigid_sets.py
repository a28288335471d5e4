"""
The largest set of matches of two panoramas that one relative pose explains exactly.

Things that were moved together between two sweeps agree with another pose than all that stayed,
and within the errors of a whole panorama both agree with a pose in between. So the pose and the
noise of matches, from that of single features up, are searched that explain most of them (RANSAC:
Fischler and Bolles, 1981), and again without the matches in each direction: what hangs on one
wall may have moved together (delete-a-group jackknife: Kott, Journal of Official Statistics
17(4), 2001).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.arrays import BoolArray
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.learning.least_squares import root_of, solve_positive, solve_root
from landmark_nav.learning.relative_pose.epipolar import (
    evidence,
    misses,
    RayPairs,
    RelativePoseConfig,
    residuals,
    TAIL,
)
from landmark_nav.learning.relative_pose.features import WIDE_BAND
from landmark_nav.types import FloatArray

# Number of sigmas of matches that are tried.
_SIGMAS = 3
# Number of samples, matches in each, and number of the best that are refined.
_SAMPLES, _SIZE, _REFINED = 300, 6, 4
# Steps of a refinement, and residual of a match that does not support a pose, sigmas.
_STEPS, _AGREES = 8, 2.5
# Relative sigma of the baseline, and sigma of the heading about the first pose: they limit the
# search.
_AROUND = 0.1
# Each group is a third of all directions; neighbouring groups overlap.
_GROUPS, _SHARE = 12, 3
# Changes of a pose by errors of panoramas, which the adjustment models, in sigmas: the 95 %
# quantile of Student's t with two degrees of freedom, those of three groups.
_NOISE_SIGMAS = 4.3


@dataclass(frozen=True, eq=False)
class RigidSet:
    """
    State (6,) of the second view by the matches (m,) that agree with it, with their sigma.

    `loading` (6, q) are the errors of the state by things that moved together, as factors with
    unit variance.
    """

    state: FloatArray
    agrees: BoolArray
    loading: FloatArray
    sigma_rad: float


def rigid_set(states: FloatArray, pairs: RayPairs, config: RelativePoseConfig) -> RigidSet:
    """
    Find the pose of the second view that most matches support.

    Parameters
    ----------
    states : ndarray, shape (v, 6)
        States of all views; that of `pairs.one` is fixed, that of `pairs.other` is the start.
    pairs : RayPairs
        Matches; there may be none.
    """
    # Errors of panoramas may be larger than those of features, and cover what moved little.
    sigmas = np.geomspace(config.feature_sigma_rad, config.direction_sigma_rad, _SIGMAS)
    searches = [_Search(states, pairs, config, float(sigma)) for sigma in sigmas]
    search = max(searches, key=lambda each: each.evidence)
    tried, support, best = search.tried, search.tried_support, search.state
    own = search.support(best)
    tried, support = np.vstack([tried, best]), np.vstack([support, own])
    azimuth = np.arctan2(pairs.rays[:, 1], pairs.rays[:, 0])
    changes = []
    for middle in 2.0 * np.pi * np.arange(_GROUPS) / _GROUPS:
        rest = np.abs(wrap_rad(azimuth - middle)) > np.pi / _SHARE
        # A few matches show no other pose.
        enough = own @ rest > _SIZE
        changes.append(search.best(tried, support, rest) - best if enough else 0.0 * best)
    changed = np.sqrt((_SHARE - 1.0) / _GROUPS) * np.array(changes).T
    loading = search.beyond_noise(changed, best, own > 0.0)
    return RigidSet(best, own > 0.0, loading, search.sigma_rad)


class _Search:
    """States of the second view of a pair, and their support."""

    def __init__(
        self, states: FloatArray, pairs: RayPairs, config: RelativePoseConfig, sigma_rad: float
    ) -> None:
        self._pair = states[[pairs.one, pairs.other]]
        self._pairs = RayPairs(0, 1, pairs.rays, pairs.other_rays)
        self.sigma_rad = sigma_rad
        self._share_of_noise = sigma_rad / config.direction_sigma_rad
        length = float(np.hypot(*(self._pair[1] - self._pair[0])[:2]))
        tilt = np.sqrt(2.0) * config.tilt_sigma_rad
        sigma = [_AROUND * length] * 2 + [_AROUND, config.rise_sigma_m, tilt, tilt]
        self._information = np.diag(np.array(sigma) ** -2.0)
        self._prior = np.array([*self._pair[1, :3], self._pair[0, 3], 0.0, 0.0])
        self.tried = self._samples()
        self.tried_support = np.array([self.support(state) for state in self.tried])
        every = np.ones(len(pairs.rays), bool)
        self.state = self.best(self.tried, self.tried_support, every)
        off, before = residuals(*self._at(self.state))
        band = WIDE_BAND / self._share_of_noise
        self.evidence = evidence(off[before & (np.abs(off) < band)], band)

    def _samples(self) -> FloatArray:
        """States (n, 6) by random samples of matches, the same each time."""
        rng = np.random.default_rng(0)
        off, jacobian, _ = misses(*self._at(self._pair[1]))
        size = min(_SIZE, len(off))
        samples = np.array([rng.permutation(len(off))[:size] for _ in range(_SAMPLES)])
        slope = jacobian[samples, 1]
        information = self._information + np.einsum('nki,nkj->nij', slope, slope)
        pull = np.einsum('nki,nk->ni', slope, off[samples])
        pull += self._information @ (self._pair[1] - self._prior)
        steps = np.linalg.solve(information, pull[..., None])[..., 0]
        return np.vstack([self._pair[1], self._pair[1] - steps])

    def support(self, state: FloatArray) -> FloatArray:
        """Support (m,) by each match."""
        off, before = residuals(*self._at(state))
        return np.asarray(before * np.maximum(0.0, 1.0 - (off / _AGREES) ** 2))

    def best(self, tried: FloatArray, support: FloatArray, which: BoolArray) -> FloatArray:
        """State with the most support by the matches `which`, refined from those tried."""
        first = np.argsort(-support @ which, kind='stable')[:_REFINED]
        refined = [self._refined(state, which) for state in tried[first]]
        return max(refined, key=lambda state: float(self.support(state) @ which))

    def beyond_noise(
        self, changes: FloatArray, state: FloatArray, agrees: BoolArray
    ) -> FloatArray:
        """Part (6, q) of changes (6, n) of a state that errors of panoramas do not explain."""
        slope = misses(*self._at(state))[1][agrees, 1] * self._share_of_noise
        root = root_of(self._information + slope.T @ slope)
        axes, size, _ = np.linalg.svd(root.T @ changes, full_matrices=False)
        beyond = np.sqrt(np.maximum(size**2 - _NOISE_SIGMAS**2, 0.0))
        return solve_root(root, (axes * beyond)[:, beyond > 0.0], transposed=True)

    def _refined(self, state: FloatArray, which: BoolArray) -> FloatArray:
        for _ in range(_STEPS):
            off, jacobian, before = misses(*self._at(state))
            weight = which * (before / (1.0 + (off / TAIL) ** 2)) ** 2
            slope = jacobian[:, 1]
            information = self._information + (slope * weight[:, None]).T @ slope
            pull = slope.T @ (weight * off) + self._information @ (state - self._prior)
            state = state - solve_positive(information, pull)
        return state

    def _at(self, state: FloatArray) -> tuple[FloatArray, RayPairs, float]:
        return np.stack([self._pair[0], state]), self._pairs, self.sigma_rad
