"""
Relative pose of two panoramas from nothing but matches: heading and direction of the way.

The camera is at one height everywhere, so that each match says something of heading and direction
at once, and all pairs of both can be tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import rotation
from landmark_nav.learning.relative_pose.epipolar import (
    center,
    DIRECTION_SIGMA_RAD,
    evidence,
    fit_poses,
    RayPairs,
    residuals,
    RISE_SIGMA_M,
    STATE,
    TILT_SIGMA_RAD,
    turned,
)
from landmark_nav.learning.relative_pose.features import BAND, LikePairs, matches_along
from landmark_nav.types import FloatArray

# Fewest matches that support a relative pose.
MIN_MATCHES = 20
# Grid of headings and directions that is tried, and how far off a match then may be.
_GRID, _TOLERANCE = 120, 0.02
# The most distinct matches are tried; so many of the best places are refined.
_MOST_TRIED, _REFINED = 600, 10
# Refined poses that differ by less are one, radians.
_SAME_RAD = 0.07
# A turn alone explains matches that are off by fewer standard deviations than this.
_TURN_SIGMAS = 4.0
# Sigmas of matches that are tried, in those of directions.
_SCATTER = (0.5, 1.0, 2.0)
# Evidence that a pose may have by chance: one of those on the grid fits best.
BY_CHANCE = 2.0 * np.log(_GRID)
_NOTHING_M = 1e-9


@dataclass(frozen=True, eq=False)
class TwoViews:
    """
    A relative pose without scale.

    `heading_rad` is that of the second base in the first, `direction_rad` that of the baseline in
    the first, `tilt_rad` (2,) that of the second relative to the first, `slope` the rise of the
    baseline over its length, `support` the number of inliers. `evidence` is the logarithm of the
    likelihood ratio of this pose to chance, by its tilt and slope, and the distances of matches
    from epipolar curves.
    """

    heading_rad: float
    direction_rad: float
    tilt_rad: FloatArray
    slope: float
    support: int
    evidence: float = 0.0


def two_views_of(states: FloatArray, one: int, other: int) -> TwoViews:
    """Relative pose of two of the states (v, 6) of sweeps."""
    here, there = states[one], states[other]
    # In the frame of the first view, which is tilted: the inverse of a rotation is its transpose.
    way = turned(here, np.eye(3)) @ (center(there) - center(here))
    heading = there[2] - here[2]
    tilt = there[4:] - rotation(-heading) @ here[4:]
    slope = float(way[2] / max(np.hypot(way[0], way[1]), _NOTHING_M))
    return TwoViews(float(heading), float(np.arctan2(way[1], way[0])), tilt, slope, 0)


def states_of(pose: TwoViews) -> FloatArray:
    """States (2, 6) of two sweeps with this relative pose, at unit distance in plan."""
    states = np.zeros((2, STATE))
    way = np.cos(pose.direction_rad), np.sin(pose.direction_rad)
    states[1] = *way, pose.heading_rad, pose.slope, *pose.tilt_rad
    return states


def hypotheses(pairs: RayPairs) -> list[TwoViews]:
    """Relative poses supported by matches, which come most distinct first; the best pose first."""
    if len(pairs.rays) < MIN_MATCHES:
        return []
    angles = 2.0 * np.pi * np.arange(_GRID) / _GRID
    votes = _votes(pairs, angles)
    found: list[TwoViews] = []
    for _ in range(_REFINED):
        heading, direction = np.unravel_index(int(np.argmax(votes)), votes.shape)
        if votes[heading, direction] <= 0.0:
            break
        around = (np.arange(-2, 3) + heading) % _GRID, (np.arange(-2, 3) + direction) % _GRID
        votes[np.ix_(*around)] = 0.0
        refined = _refined(pairs, angles[heading], angles[direction])
        if not any(_same(refined, other) for other in found):
            found.append(refined)
    return sorted(found, key=lambda pose: -pose.support)


def along_curves(poses: Sequence[TwoViews], alike: LikePairs) -> list[TwoViews]:
    """
    Refine relative poses with all matches near their epipolar curves; that of most evidence first.

    These are many more than the distinct ones, and poses that differ little may become one.
    """
    refined = []
    for pose in poses:
        pairs = matches_along(0, 1, states_of(pose), alike)
        refined.append(_refined(pairs, pose.heading_rad, pose.direction_rad))
    refined.sort(key=lambda pose: -pose.evidence)
    return [p for k, p in enumerate(refined) if not any(_same(p, o) for o in refined[:k])]


def turn_support(pairs: RayPairs, sigma_rad: float) -> int:
    """Number of matches that a rotation alone explains: all of them without a baseline."""
    azimuth, other = (np.arctan2(r[:, 1], r[:, 0]) for r in (pairs.rays, pairs.other_rays))
    bound = _TURN_SIGMAS * sigma_rad
    level = np.abs(pairs.other_rays[:, 2] - pairs.rays[:, 2]) < bound
    turn = (azimuth - other)[level]
    alike = np.abs(wrap_rad(turn[:, None] - turn)) < bound
    return int(alike.sum(1).max(initial=0))


def _votes(pairs: RayPairs, angles: FloatArray) -> FloatArray:
    """Support of each heading and direction by matches, (n, n)."""
    azimuth, other, tangent, other_tangent = (
        part[:_MOST_TRIED].astype(np.float32)
        for part in (
            *(np.arctan2(r[:, 1], r[:, 0]) for r in (pairs.rays, pairs.other_rays)),
            *(r[:, 2] for r in (pairs.rays, pairs.other_rays)),
        )
    )
    angles = angles.astype(np.float32)
    away, there = np.sin(azimuth - angles[:, None]), np.sin(other + angles[:, None])
    miss, other_miss, ahead = tangent * there, other_tangent * away, away > 0.0
    size, other_size = _TOLERANCE**2 * there**2, _TOLERANCE**2 * (away**2 + 1e-9)
    votes = np.zeros((len(angles), len(angles)))
    for k, heading in enumerate(angles):
        # Row of `there` for each direction: headings and directions are on one grid.
        row = (k - np.arange(len(angles))) % len(angles)
        parallax = np.sin(other + heading - azimuth) > 0.0
        before = (ahead == (there > 0.0)[row]) & (ahead == parallax)
        off = (miss[row] - other_miss) ** 2 / (size[row] + other_size)
        votes[k] = np.sum(before * np.maximum(0.0, 1.0 - off), axis=1)
    return votes


def _refined(pairs: RayPairs, heading: float, direction: float) -> TwoViews:
    prior = np.zeros((2, STATE))
    prior[1, :3] = np.cos(direction), np.sin(direction), heading
    rise, tilt = RISE_SIGMA_M, TILT_SIGMA_RAD
    sigma = np.array([[1e-6] * STATE, [1.0, 1.0, 10.0, rise, tilt, tilt]]).ravel()
    pairs = RayPairs(0, 1, pairs.rays, pairs.other_rays)
    fit = fit_poses(
        prior,
        [pairs],
        DIRECTION_SIGMA_RAD,
        prior,
        np.diag(sigma**2),
    )
    found = two_views_of(fit.states, 0, 1)
    off, before = residuals(fit.states, pairs, DIRECTION_SIGMA_RAD)
    near = off[before & (np.abs(off) < BAND)]
    unlikely = 0.5 * float(np.sum(((fit.states[1, 3:] - prior[1, 3:]) / sigma[STATE + 3 :]) ** 2))
    return replace(
        found,
        heading_rad=float(wrap_rad(found.heading_rad)),
        support=int(fit.agrees[0].sum()),
        evidence=max(evidence(near / s, BAND / s) for s in _SCATTER) - unlikely,
    )


def _same(one: TwoViews, other: TwoViews) -> bool:
    apart = [one.heading_rad - other.heading_rad, one.direction_rad - other.direction_rad]
    return bool(np.abs(wrap_rad(np.array(apart))).max() < _SAME_RAD)
