"""Positions of matched features, by the poses of the panoramas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from landmark_nav.arrays import BoolArray
from landmark_nav.learning.relative_pose.epipolar import center, RayPairs, turned
from landmark_nav.types import FloatArray

# Points with a larger sigma, m, or a smaller parallax, rad, are not used.
_MAX_SIGMA_M, _LEAST_PARALLAX = 0.15, 0.035


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """
    Points (n, 3) in map, their covariance in plan (n, 2, 2), and one viewpoint of each (n, 3).

    The covariance is without errors of the poses, which all points share.
    """

    positions: FloatArray
    covariance: FloatArray
    viewpoints: FloatArray

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.positions)

    @classmethod
    def joined(cls, parts: Sequence[SeenPoints]) -> SeenPoints:
        """Concatenate several sets."""
        return cls(
            np.concatenate([p.positions for p in parts]),
            np.concatenate([p.covariance for p in parts]),
            np.concatenate([p.viewpoints for p in parts]),
        )

    def chosen(self, which: BoolArray) -> SeenPoints:
        """Return the points selected by `which` (n,)."""
        return SeenPoints(self.positions[which], self.covariance[which], self.viewpoints[which])


def placed_matches(
    states: FloatArray, pairs: RayPairs, sigma_rad: float
) -> tuple[SeenPoints, RayPairs]:
    """
    Intersect the rays of matches between two views in plan.

    Parameters
    ----------
    states : ndarray, shape (v, 6)
        States of the sweeps, from `relative_poses`.
    pairs : RayPairs
        Inlier matches.
    sigma_rad : float
        Sigma of a direction.
    """
    here, there = (center(states[k]) for k in (pairs.one, pairs.other))
    w = turned(states[pairs.one], pairs.rays)
    v = turned(states[pairs.other], pairs.other_rays)
    w, v = (r / np.hypot(r[:, 0], r[:, 1])[:, None] for r in (w, v))
    way = there - here
    sine = w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]
    with np.errstate(divide='ignore', invalid='ignore'):
        reach = (way[0] * v[:, 1] - way[1] * v[:, 0]) / sine
        reach_there = (way[0] * w[:, 1] - way[1] * w[:, 0]) / sine
        first, second = here + reach[:, None] * w, there + reach_there[:, None] * v
        along = (reach_there * sigma_rad / sine) ** 2, (reach * sigma_rad / sine) ** 2
    covariance = (
        along[1][:, None, None] * v[:, :2, None] * v[:, None, :2]
        + along[0][:, None, None] * w[:, :2, None] * w[:, None, :2]
    )
    certain = (np.abs(sine) > np.sin(_LEAST_PARALLAX)) & (reach > 0.0) & (reach_there > 0.0)
    certain &= np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1]) < _MAX_SIGMA_M
    points = SeenPoints(
        0.5 * (first + second)[certain],
        covariance[certain],
        np.broadcast_to(here, first.shape)[certain],
    )
    return points, pairs.chosen(certain)
