"""
Poses of all sweeps: their shape from the panoramas, their scale from what was known before.

Pairs of panoramas give headings and directions; from these, along the best pairs, all are placed,
and then fitted to all matches at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtri

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import relative
from landmark_nav.learning.least_squares import covariance_of
from landmark_nav.learning.relative_pose.config import RelativePoseConfig
from landmark_nav.learning.relative_pose.epipolar import (
    center,
    EpipolarFit,
    fit_poses,
    RayPairs,
    STATE,
)
from landmark_nav.learning.relative_pose.features import alike, Features
from landmark_nav.learning.relative_pose.matches import matches_along
from landmark_nav.learning.relative_pose.two_views import hypotheses, turn_support, TwoViews
from landmark_nav.types import FloatArray, PlaceChain

__all__ = ['RelativePoses', 'relative_poses']

# Each sweep is compared with so many of those nearest to it.
_NEIGHBOURS = 4
# Chance that known poses miss what the panoramas say by more; their variances then grow, up to
# this factor, beyond which they are refused.
_CHANCE, _MOST_INFLATED = 1e-4, 30.0
# Matches that a turn alone explains, as a share of those that a way does, where there is no way.
_NO_WAY = 0.8
_FIXED_SIGMA = 1e-6


@dataclass(frozen=True, eq=False)
class RelativePoses:
    """
    Sweeps in the frame of the first one.

    Parameters
    ----------
    states : ndarray, shape (v, 6)
        x, y, heading of the base, height above the first (m), tilt about x and y of the base.
    places : PlaceChain
        What was known of them before, with the covariance that fits the panoramas.
    pairs : tuple of RayPairs
        Matches that agree.
    inflation : float
        Factor by which that covariance had to grow, at least 1.
    tilt_information : ndarray, shape (v, 2, 2)
        Of the tilt of each sweep.

    """

    states: FloatArray
    places: PlaceChain
    pairs: tuple[RayPairs, ...]
    inflation: float
    tilt_information: FloatArray


def relative_poses(
    features: Sequence[Features], places: PlaceChain, lever: FloatArray, config: RelativePoseConfig
) -> RelativePoses:
    """
    Find the poses of sweeps from what their panoramas show, and what is known before.

    Parameters
    ----------
    features : sequence of Features
        Of the panorama of each sweep.
    places : PlaceChain
        Poses of the base that are known before, with their scale.
    lever : ndarray, shape (3,)
        Viewpoint in the base frame, metres.
    config : RelativePoseConfig
        What counts.

    Raises
    ------
    LandmarkNavError
        Panoramas that share too little, no way between them, or poses known before that
        contradict them.

    """
    found: dict[tuple[int, int], TwoViews] = {}
    for i, j in _neighbours(places.poses):
        matches = alike(features[i], features[j], config.max_ratio)
        pairs = RayPairs(i, j, features[i].rays[matches[:, 0]], features[j].rays[matches[:, 1]])
        ranked = hypotheses(pairs, config)
        turn = turn_support(pairs, config.direction_sigma_rad)
        agreed = ranked[0].support if ranked else 0
        if turn >= max(config.min_matches, _NO_WAY * agreed):
            raise LandmarkNavError(
                f'the panoramas of sweeps {i + 1} and {j + 1} are from one place: take another '
                'sweep 1 to 3 m away'
            )
        if _stands_out(ranked, config):
            found[i, j] = ranked[0]
    start = _placed(found, places, lever)
    fit, inflation, pairs_along = _fitted(start, found, features, places, lever, config)
    count = len(fit.states)
    covariance = covariance_of(fit.information).reshape(count, STATE, count, STATE)
    tilts = np.array([covariance_of(covariance[k, 4:, k, 4:]) for k in range(count)])
    return RelativePoses(
        fit.states,
        PlaceChain(places.poses, inflation * places.covariance),
        tuple(p.chosen(which) for p, which in zip(pairs_along, fit.agrees, strict=True)),
        inflation,
        tilts,
    )


def _neighbours(poses: FloatArray) -> list[tuple[int, int]]:
    """Pairs of sweeps to compare: consecutive ones, and those near each other."""
    away = np.hypot(*(poses[:, None, :2] - poses[None, :, :2]).transpose(2, 0, 1))
    near = {(k, k + 1) for k in range(len(poses) - 1)}
    for k, order in enumerate(np.argsort(away, 1, kind='stable')[:, 1 : _NEIGHBOURS + 1]):
        near |= {(min(k, int(j)), max(k, int(j))) for j in order}
    return sorted(near)


def _stands_out(ranked: Sequence[TwoViews], config: RelativePoseConfig) -> bool:
    if not ranked or ranked[0].support < config.min_matches:
        return False
    return len(ranked) == 1 or ranked[1].support <= config.max_rival * ranked[0].support


def _placed(
    found: dict[tuple[int, int], TwoViews], places: PlaceChain, lever: FloatArray
) -> FloatArray:
    """States (v, 6) along the pairs with most support, as far apart as was known before."""
    count = len(places.poses)
    states = np.zeros((count, STATE))
    states[0, :3] = places.poses[0]
    placed = {0}
    while len(placed) < count:
        ways = [e for e in found if (e[0] in placed) != (e[1] in placed)]
        if not ways:
            alone = next(k for k in range(count) if k not in placed)
            raise LandmarkNavError(
                f'the panorama of sweep {alone + 1} shares too little with the others: take '
                'sweeps 1 to 2 m apart that see the same textured walls'
            )
        i, j = max(ways, key=lambda e: found[e].support)
        pose, forward = found[i, j], i in placed
        known, new = (i, j) if forward else (j, i)
        turn = pose.heading_rad if forward else -pose.heading_rad
        heading = states[known, 2] + turn
        course = pose.direction_rad + (states[i, 2] if forward else heading)
        course += 0.0 if forward else np.pi
        ends = [_viewpoint(places.poses[k], lever) for k in (known, new)]
        eye = center(states[known], lever)[:2]
        eye = eye + np.hypot(*(ends[1] - ends[0])) * np.array([np.cos(course), np.sin(course)])
        states[new, 2] = wrap_rad(heading)
        states[new, :2] = eye - center(np.array([0, 0, heading, 0, 0, 0.0]), lever)[:2]
        placed.add(new)
    return states


def _viewpoint(pose: FloatArray, lever: FloatArray) -> FloatArray:
    return center(np.array([*pose, 0.0, 0.0, 0.0]), lever)[:2]


def _fitted(
    start: FloatArray,
    found: dict[tuple[int, int], TwoViews],
    features: Sequence[Features],
    places: PlaceChain,
    lever: FloatArray,
    config: RelativePoseConfig,
) -> tuple[EpipolarFit, float, list[RayPairs]]:
    """Fit to all matches; the factor on what was known; the matches."""
    count = len(start)
    prior = np.zeros((count, STATE))
    prior[:, :3] = places.poses
    inflation, states = 1.0, start
    for _ in range(3):
        pairs = [matches_along(i, j, states, features, lever, config) for i, j in sorted(found)]
        covariance = _prior_covariance(inflation * places.covariance, config)
        fit = fit_poses(states, pairs, lever, config.direction_sigma_rad, prior, covariance)
        states = fit.states
        freedom = 3 * (count - 1)
        misfit = _misfit(fit.states, places)
        inflation = misfit / freedom if misfit > chdtri(freedom, _CHANCE) else 1.0
        if inflation > _MOST_INFLATED:
            raise LandmarkNavError(_contradiction(fit.states, places))
    return fit, inflation, pairs


def _misfit(states: FloatArray, places: PlaceChain) -> float:
    """Squared misfit of what was known of poses before, without their scale."""
    off = states[1:, :3] - places.poses[1:]
    off[:, 2] = wrap_rad(off[:, 2])
    return float(off.ravel() @ np.linalg.solve(places.covariance[3:, 3:], off.ravel()))


def _contradiction(states: FloatArray, places: PlaceChain) -> str:
    """Say between which sweeps poses known before and panoramas disagree most."""
    turns = []
    for k in range(len(states) - 1):
        seen = relative(states[k, :3], states[k + 1, :3])
        known = relative(places.poses[k], places.poses[k + 1])
        course = np.arctan2(seen[1], seen[0]) - np.arctan2(known[1], known[0])
        turns.append(np.degrees(wrap_rad(np.array([seen[2] - known[2], course]))))
    worst = int(np.argmax([np.abs(t).max() for t in turns]))
    heading, course = turns[worst]
    return (
        f'odometry and panoramas disagree from sweep {worst + 1} to {worst + 2}: by '
        f'{heading:+.1f} deg in heading, {course:+.1f} deg in direction: mend odom, or drive '
        'again without slipping'
    )


def _prior_covariance(places: FloatArray, config: RelativePoseConfig) -> FloatArray:
    """Covariance (6 v, 6 v) of states before there are matches."""
    count = len(places) // 3
    rise, tilt = config.rise_sigma_m, config.tilt_sigma_rad
    rest = block_diag(*[np.diag([rise**2, tilt**2, tilt**2])] * count)
    rest[0, 0] = _FIXED_SIGMA**2
    joint = np.zeros((count, STATE, count, STATE))
    joint[:, :3, :, :3] = places.reshape(count, 3, count, 3)
    joint[:, 3:, :, 3:] = rest.reshape(count, 3, count, 3)
    joint[0, range(3), 0, range(3)] += _FIXED_SIGMA**2
    return joint.reshape(count * STATE, count * STATE)
