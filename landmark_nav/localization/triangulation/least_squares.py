"""Weighted least squares on bearings: start, Gauss-Newton, and which bearing is the odd one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.arrays import BoolArray
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.triangulation.model import (
    bearing_gradients,
    bearing_residuals,
    map_share,
    triples,
)
from landmark_nav.localization.triangulation.three import triangulate_three
from landmark_nav.types import FloatArray, PoseEstimate, Refusal

__all__ = ['Solution', 'best_start', 'solve', 'w_statistics']

# Triples tried as starts: all of them up to 12 landmarks.
_MAX_STARTS = 220
_MAX_STEPS = 20
# Least share of its information that is left of a direction.
_LEAST_EIGENVALUE = 1e-9
_UNDETERMINED = Refusal('degenerate geometry', 'the bearings leave a direction undetermined')


@dataclass(frozen=True, eq=False)
class Solution:
    """A least-squares pose (3,), its covariance (3, 3), Jacobian, residuals and weights."""

    pose: FloatArray
    covariance: FloatArray
    jacobian: FloatArray
    residual: FloatArray
    weight: FloatArray

    @property
    def chi_square(self) -> float:
        """Of the residuals."""
        return float(self.residual @ self.weight @ self.residual)

    def covariance_without(self, rows: BoolArray) -> FloatArray:
        """Covariance (3, 3) that the pose would have without some of the bearings, `rows` (n,)."""
        weighted = (self.weight @ self.jacobian)[rows]
        lost = weighted.T @ np.linalg.solve(self.weight[np.ix_(rows, rows)], weighted)
        # In units of the covariance rounding does not matter; what is left undetermined then has
        # a large variance, not none.
        root = np.linalg.cholesky(self.covariance)
        value, vector = np.linalg.eigh(np.eye(3) - root.T @ lost @ root)
        back = root @ vector
        return np.asarray(back / np.maximum(value, _LEAST_EIGENVALUE) @ back.T)


def best_start(
    position: FloatArray, bearing: FloatArray, variance: FloatArray, start: PoseEstimate | None
) -> FloatArray | None:
    """Pose (3,) of the triple, or the prior, at which the bearings agree best, outliers aside."""
    index = triples(len(bearing), _MAX_STARTS)
    poses = triangulate_three(position[index], bearing[index])
    if start is not None:
        poses = np.vstack([poses, start.pose])
    poses = poses[np.isfinite(poses).all(axis=-1)]
    if not len(poses):
        return None
    # Cauchy's cost: an outlier weighs by the logarithm of its residual.
    square = bearing_residuals(poses, position, bearing) ** 2 / variance
    return np.asarray(poses[np.argmin(np.sum(np.log1p(square / 9.0), axis=-1))])


def solve(
    position: FloatArray,
    bearing: FloatArray,
    variance: FloatArray,
    map_cov: FloatArray,
    start: FloatArray,
) -> Solution | Refusal:
    """Gauss-Newton with weights renewed at every iterate and steps of at most 1 m and 1 rad."""
    pose, jacobian = start.copy(), np.full((len(bearing), 3), -1.0)
    for _ in range(_MAX_STEPS):
        gradient = bearing_gradients(pose, position)
        residual = bearing_residuals(pose, position, bearing)
        jacobian[:, :2] = gradient
        weight = np.asarray(np.linalg.inv(np.diag(variance) + map_share(gradient, map_cov)))
        normal = jacobian.T @ weight @ jacobian
        # A normal matrix scaled to unit diagonal separates rank from units.
        scale = 1.0 / np.sqrt(np.maximum(normal.diagonal(), 1e-100))
        scaled = normal * scale[:, None] * scale
        if not np.isfinite(scaled).all():
            return _UNDETERMINED
        value, vector = np.linalg.eigh(scaled)
        if value[0] < 1e-12:
            return _UNDETERMINED
        scaled_back = scale[:, None] * vector
        covariance: FloatArray = scaled_back / value @ scaled_back.T
        step = covariance @ (jacobian.T @ (weight @ residual))
        step /= max(1.0, float(np.hypot(step[0], step[1])), abs(float(step[2])))
        pose = pose + step
        # The next would be a hundred times smaller at least.
        if np.abs(step).max() < 1e-8:
            pose[2] = wrap_rad(pose[2])
            return Solution(pose, covariance, jacobian, residual, weight)
    return Refusal('no convergence', f'last step {np.abs(step).max():.1e} m or rad')


def w_statistics(solved: Solution) -> FloatArray:
    """Residuals (n,) in units of what each would be off by if it alone were wrong."""
    weighted = solved.weight @ solved.residual
    spread = solved.weight @ solved.jacobian
    variance = np.diag(solved.weight - spread @ solved.covariance @ spread.T)
    return np.asarray(np.abs(weighted) / np.sqrt(np.maximum(variance, 1e-300)))
