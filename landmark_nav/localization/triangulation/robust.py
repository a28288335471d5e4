"""
The pose from bearings to known landmarks, with its first-order covariance, or why there is none.

The unknown is the pose of the pan axis with the orientation of the base; `base_from_axis` gives
the pose of the base.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from landmark_nav.arrays import BoolArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import squared_distance
from landmark_nav.localization.triangulation.model import (
    bearing_residuals,
    Bearings,
    danger_distance,
    Fix,
    w_statistics,
)
from landmark_nav.parameters import Config
from landmark_nav.types import FloatArray, PoseEstimate, Refusal

# Chi-square level of the test against the prior.
_START_PROBABILITY = 0.9999
# Least distance of a fix from the circle through its three landmarks, relative to its radius or
# to the range (0.075 corresponds to a power of 0.15 squared radii).
_DANGER_MARGIN = 0.075


@dataclass(frozen=True)
class TriangulationConfig(Config):
    """
    When a fix is accepted.

    The values are chosen by hand. Fixes are shown to people and start the search; the estimator
    does not use them.
    """

    # Chi-square level of the test that all bearings fit one pose.
    fit_probability: float = 0.999
    # Largest predicted position sigma (root of the trace), m.
    max_sigma_m: float = 0.3
    # Least distance from a landmark, m.
    min_range_m: float = 0.5


def triangulate(
    positions: npt.ArrayLike,
    bearings: npt.ArrayLike,
    variances: npt.ArrayLike,
    map_covariance: npt.ArrayLike | None = None,
    start: PoseEstimate | None = None,
    config: TriangulationConfig | None = None,
) -> Fix | Refusal:
    """
    Weighted least squares with outlier rejection, started from the closed form of each triple.

    Weights are ``(S_b + G Sigma_L G^T)^-1`` with G the derivative of the bearings by the
    landmarks. An outlier is the bearing with the largest w-statistic (Baarda, A Testing Procedure
    for Use in Geodetic Networks, 1968) while the chi-square test fails and four others remain.

    Raises `LandmarkNavError`: arrays that do not match, values that are not finite, variances that
    are not positive.

    Parameters
    ----------
    positions : array_like, shape (n, 2)
        Landmarks in map, metres.
    bearings, variances : array_like, shape (n,)
        Bearings at the pan axis [rad] and their own variances [rad^2].
    map_covariance : array_like, shape (2n, 2n), optional
        Joint covariance of `positions`, metres squared.
    start : PoseEstimate, optional
        Prior of the pan axis: tried as a start, and the fix must be plausible beside it.
    config : TriangulationConfig, optional
        Limits.
    """
    config = config or TriangulationConfig()
    given = _checked(positions, bearings, variances, map_covariance)
    n = len(given.bearing)
    if n < 3:
        return Refusal('fewer than three bearings', f'{n} given')
    used = np.ones(n, dtype=np.bool_)
    solved = None if start is None else given.solve(start.pose)
    # No other start is needed if all bearings fit a pose near the prior.
    if not isinstance(solved, Fix) or solved.chi_square > _limit(n, config):
        pose = given.best_start(start)
        if pose is None:
            return Refusal('degenerate geometry', 'no three landmarks fix a pose')
        solved = _without_outliers(given, pose, used, config)
        if isinstance(solved, Refusal):
            return solved
    fix = replace(solved, used=used)
    return _refusal(fix, given.position[used], start, config) or fix


def _without_outliers(
    given: Bearings, pose: FloatArray, used: BoolArray, config: TriangulationConfig
) -> Fix | Refusal:
    """Solve from a pose (3,); sets `used` (n,) to False for outliers."""
    while True:
        index = np.flatnonzero(used)
        rest = given.chosen(index)
        solved = rest.solve(pose)
        if isinstance(solved, Refusal):
            if len(index) <= 4:
                return solved
            # Outliers corrupted the solution: remove the worst of them as seen from the start.
            residual = bearing_residuals(pose, rest.position, rest.bearing)
            used[index[np.argmax(residual**2 / rest.variance)]] = False
            continue
        limit = _limit(len(index), config)
        if solved.chi_square <= limit:
            return solved
        if len(index) <= 4:
            largest = np.degrees(np.abs(solved.residual).max())
            return Refusal(
                'bearings do not meet',
                f'chi-square {solved.chi_square:.1f} of {len(index)} bearings, limit '
                f'{limit:.1f}, largest residual {largest:.2f} deg',
            )
        used[index[np.argmax(w_statistics(solved))]] = False


def _limit(count: int, config: TriangulationConfig) -> float:
    """Chi-square limit for a number of bearings."""
    # Three bearings have no redundancy; one degree of freedom allows for rounding.
    return float(chdtri(max(count - 3, 1), 1.0 - config.fit_probability))


def _checked(
    positions: npt.ArrayLike,
    bearings: npt.ArrayLike,
    variances: npt.ArrayLike,
    map_covariance: npt.ArrayLike | None,
) -> Bearings:
    position = np.asarray(positions, dtype=np.float64).reshape(-1, 2)
    bearing = np.asarray(bearings, dtype=np.float64)
    variance = np.asarray(variances, dtype=np.float64)
    n = len(bearing)
    covariance = np.zeros((2 * n, 2 * n)) if map_covariance is None else map_covariance
    map_cov = np.asarray(covariance, dtype=np.float64)
    if len(position) != n or variance.shape != (n,) or map_cov.shape != (2 * n, 2 * n):
        raise LandmarkNavError(
            f'triangulation: {len(position)} positions, {n} bearings, {len(variance)} variances, '
            f'map covariance {map_cov.shape}: give n, n, n and (2n, 2n)'
        )
    if not all(np.isfinite(a).all() for a in (position, bearing, variance, map_cov)):
        raise LandmarkNavError('triangulation: a position, bearing or variance is not a number')
    if np.any(variance <= 0.0):
        raise LandmarkNavError('triangulation: bearing variances must be positive')
    return Bearings(position, bearing, variance, map_cov)


def _refusal(
    fix: Fix, position: FloatArray, start: PoseEstimate | None, config: TriangulationConfig
) -> Refusal | None:
    """Return why a fix is not accepted; None if it is."""
    nearest = float(np.min(np.hypot(*(position - fix.pose[:2]).T)))
    if nearest < config.min_range_m:
        return Refusal('too close to a landmark', f'{nearest:.2f} m')
    sigma = float(np.sqrt(np.trace(fix.covariance[:2, :2])))
    if sigma > config.max_sigma_m:
        return Refusal('too uncertain', f'position sigma {sigma:.2f} m')
    if len(position) == 3:
        distance, relative = danger_distance(fix.pose[:2], position)
        if relative < _DANGER_MARGIN or distance < 3.0 * sigma:
            where = f'{distance:.2f} m from the circle through the three landmarks'
            return Refusal('danger circle', where)
    if start is not None:
        spread = start.covariance + fix.covariance
        distance_sq = squared_distance(fix.pose, start.pose, spread)
        if distance_sq > float(chdtri(3, 1.0 - _START_PROBABILITY)):
            x, y, turn = fix.pose - start.pose
            away = f'{np.hypot(x, y):.2f} m and {np.degrees(wrap_rad(turn)):.1f} deg away'
            return Refusal('far from the expected place', away)
    return None
