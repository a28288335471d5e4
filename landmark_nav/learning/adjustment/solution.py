"""
Joint least squares of landmarks and panorama poses: a small bundle adjustment.

Errors that landmarks share (those of the panoramas' poses) are kept apart from their own errors,
and the map has both. The sigmas of panoramas, papers, walls and of the distances of objects from
walls are estimated from the residuals of the room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri

from landmark_nav.arrays import BoolArray
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment.problem import AdjustmentConfig, Linearized, Problem, Weights
from landmark_nav.learning.least_squares import Damping, root_of
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement, Ties
from landmark_nav.types import FloatArray, Panorama

_MAX_ITERATIONS = 15
# Step at convergence, and longest step of a landmark, m.
_CONVERGED, _LONGEST_M = 1e-7, 1.0
# Chi-square at which a landmark's weight has fallen to a quarter, in the first and the last step.
_TAIL_WIDTH_AT_FIRST, _TAIL_WIDTH = 100.0, 6.0
# Significance at which a landmark is an outlier, without influence on shared unknowns.
_OUTLIER_PROBABILITY = 0.01
_NO_INFLUENCE = 1e-6
# Residuals of more sigmas are down-weighted to this number.
_TAIL_SIGMAS = 2.5
_NOISE_ITERATIONS = 60
_NOISE_CONVERGED = 1e-3
# Shared factors of a map; the others account for less than a tenth of a millimetre.
_MOST_FACTORS = 16
# Sigma of the start of a patch on its own plane.
_NO_WALL_M = 1.0
# Indices among the sigmas that are estimated.
_RELIEF, _SPREAD, _HANGING = 2, slice(3, 8), slice(5, 8)
_PLACES = np.array([3, 4])


@dataclass(frozen=True, eq=False)
class Adjustment:
    """
    Landmarks and panoramas after the adjustment.

    `positions` (n, 3) of the landmarks are in map, m, with the covariance of the own error of each
    and loadings of m shared factors with unit variance. `poses` (views, 4) are x, y, z, heading of
    the panoramas. `off_wall_m` (n,) is the distance of each landmark from its wall, positive in
    front; `chi_square` (n,) the misfit of its measurements and its wall. `noise` (8,) are the
    estimated sigmas of azimuths, tangents and relief; factors, 1 or more, on the prior sigmas of
    panoramas in plan and in height; sigmas of the distance of objects from all walls, of the
    position of a wall, and of the distance from a section of wall. `calibration` (c,) are the
    values of `CALIBRATED`, with covariance and loadings (c, m) by the shared factors; c is 0 if a
    panorama has no calibration.
    """

    positions: FloatArray
    own_covariance: FloatArray
    shared_loading: FloatArray
    poses: FloatArray
    pose_covariance: FloatArray
    off_wall_m: FloatArray
    chi_square: FloatArray
    noise: FloatArray
    calibration: FloatArray = field(default_factory=lambda: np.zeros(0))
    calibration_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    calibration_loading: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def hanging_sigma_m(self) -> float:
        """Sigma of the distance of objects from a section of wall."""
        return float(self.noise[_HANGING][-1])


def adjust(
    measurements: Sequence[Sequence[PatchMeasurement]],
    walls: Sequence[int],
    start: FloatArray,
    panoramas: Sequence[Panorama],
    places: FloatArray,
    room: Room,
    config: AdjustmentConfig,
    normals: FloatArray | None = None,
    ties: Ties | None = None,
) -> Adjustment:
    """
    Adjust n landmarks and the poses of panoramas to all measurements.

    Parameters
    ----------
    measurements, walls : sequence
        Measurements of each landmark, and its wall; -1 if it has a plane of its own.
    start : ndarray, shape (n, 3)
        Initial positions.
    panoramas : sequence of Panorama
        Panoramas with prior poses.
    places : ndarray, shape (4 * views, 4 * views)
        Joint covariance of these poses, from `reference_area.joint_covariance`.
    normals : ndarray, shape (n, 3), optional
        Normals of the landmarks; those on walls have that of their wall.
    ties : Ties, optional
        Tie points: they constrain the poses and are no landmarks.
    """
    if normals is None:
        normals = room.normals[np.asarray(walls, dtype=np.intp)]
    count = len(start)
    if ties is not None:
        measurements = [*measurements, *ties.measurements]
        walls = [*walls, *[-1] * len(ties.positions)]
        start = np.concatenate([start, ties.positions])
        normals = np.concatenate([normals, np.tile([1.0, 0.0, 0.0], (len(ties.positions), 1))])
    problem = Problem(measurements, walls, panoramas, places, room, normals, start, config)
    seen = config.azimuth_sigma_rad, config.tangent_sigma
    hanging = config.common_hanging_sigma_m, config.wall_sigma_m, config.hanging_sigma_m
    expected = np.array([*seen, config.relief_sigma_m, 1.0, 1.0, *hanging])
    at = _settle(problem, start, expected)
    # A position takes three degrees of freedom.
    freedom = 2 * np.bincount(problem.landmark, minlength=problem.count) + 1 - 3
    misfit = _misfit(problem, at, expected)
    trusted = misfit < chdtri(freedom, _OUTLIER_PROBABILITY)
    influence = np.where(trusted, 1.0, _NO_INFLUENCE)
    weight = np.full(len(expected), config.camera_weight)
    weight[_PLACES] = config.place_weight
    weight[_HANGING] = config.room_weight
    noise, damping = expected, Damping()
    for _ in range(_NOISE_ITERATIONS):
        weights = _information(problem, at, noise, influence)
        at, moved = _step(problem, at, weights, damping)
        better, fewness = _noise(problem, at, noise, expected, influence, weight)
        still = np.abs(better / noise - 1.0).max() < _NOISE_CONVERGED
        noise = better
        if still and moved < _CONVERGED:
            break
    # The mean of a variance exceeds its mode, the more so the fewer residuals it is based on.
    noise = noise * np.sqrt(fewness)
    points, shared = at.points, at.shared
    weights = _information(problem, at, noise, influence)
    equations = problem.normal_equations(at, weights)
    covariance = equations.shared_covariance.copy()
    if ties is not None:
        covariance[problem.pose_part, problem.pose_part] += (
            ties.shared_errors @ ties.shared_errors.T
        )
    of_poses, views = covariance[problem.pose_part, problem.pose_part], np.arange(problem.views)
    root = root_of(covariance)
    shared_loading, rest, axes = _main_factors(equations.by_factors(root, count))
    return Adjustment(
        points[:count],
        (influence[:, None, None] * equations.own_covariance)[:count] + rest,
        shared_loading,
        problem.poses(shared),
        of_poses.reshape(problem.views, 4, problem.views, 4)[views, :, views],
        problem.off_wall(points)[:count],
        _misfit(problem, at, noise, trusted)[:count],
        noise,
        shared[problem.calibration_part],
        covariance[problem.calibration_part, problem.calibration_part],
        root[problem.calibration_part] @ axes,
    )


def _settle(problem: Problem, start: FloatArray, sigma: FloatArray) -> Linearized:
    """Robust initial landmarks and shared unknowns, and the problem there."""
    at, damping = problem.linearize(start, problem.prior), Damping()
    for step in range(_MAX_ITERATIONS):
        # False matches and objects off the walls must affect neither their neighbours nor the
        # poses, even if they are many: a redescending weight (Geman and McClure, 1987), narrower
        # with each step, as the poses explain more of the misfit.
        tail_width = max(_TAIL_WIDTH_AT_FIRST / 2**step, _TAIL_WIDTH)
        weight = (1.0 + _misfit(problem, at, sigma) / tail_width) ** -2.0
        seen, wall = _variances(problem, sigma)
        weights = Weights(weight[problem.landmark, None] / seen, weight / wall, sigma[_SPREAD])
        at, moved = _step(problem, at, weights, damping)
        if step > 4 and moved < _CONVERGED:
            break
    return at


def _step(
    problem: Problem, at: Linearized, weights: Weights, damping: Damping
) -> tuple[Linearized, float]:
    """The problem after one damped step, and the largest change."""
    equations = problem.normal_equations(at, weights)

    def stepped(by: float) -> Linearized:
        points, shared = equations.damped(by).solve()
        length = np.linalg.norm(points, axis=1, keepdims=True)
        points = points * np.minimum(1.0, _LONGEST_M / np.maximum(length, _LONGEST_M))
        return problem.linearize(at.points + points, at.shared + shared)

    there = damping.step(at, stepped, lambda state: problem.cost(state, weights))
    changes = there.points - at.points, there.shared - at.shared
    return there, max(float(np.abs(change).max()) for change in changes)


def _main_factors(loading: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Largest factors (n, 3, f) of loadings (n, 3, m), the remaining covariances, axes (m, f)."""
    count = len(loading)
    turned, size, axes = np.linalg.svd(loading.reshape(3 * count, -1), full_matrices=False)
    factors = (turned * size).reshape(count, 3, -1)
    rest = factors[..., _MOST_FACTORS:]
    return factors[..., :_MOST_FACTORS], rest @ rest.swapaxes(-1, -2), axes[:_MOST_FACTORS].T


def _variances(problem: Problem, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Variances of measurements (k, 2) and walls (n,)."""
    relief = np.where(problem.on_wall, noise[_RELIEF], _NO_WALL_M)
    return problem.own_sigma**2 + noise[:2] ** 2, relief**2


def _tail(residual: FloatArray, variance: FloatArray) -> FloatArray:
    """Robust weight of a residual."""
    with np.errstate(divide='ignore'):
        return np.asarray(np.minimum(1.0, _TAIL_SIGMAS**2 * variance / residual**2))


def _information(
    problem: Problem, at: Linearized, noise: FloatArray, influence: FloatArray
) -> Weights:
    seen, wall = _variances(problem, noise)
    return Weights(
        influence[problem.landmark, None] * _tail(at.seen, seen) / seen,
        influence * _tail(at.wall, wall) / wall,
        noise[_SPREAD],
    )


def _misfit(
    problem: Problem,
    at: Linearized,
    noise: FloatArray,
    trusted: BoolArray | bool = False,
) -> FloatArray:
    """Chi-square of each landmark (n,); the wall's part is robust for those `trusted`."""
    seen, wall = _variances(problem, noise)
    share = np.where(trusted, _tail(at.wall, wall), 1.0)
    sums = np.bincount(problem.landmark, np.sum(at.seen**2 / seen, 1), problem.count)
    return np.asarray(sums + share * at.wall**2 / wall)


def _noise(
    problem: Problem,
    at: Linearized,
    noise: FloatArray,
    expected: FloatArray,
    influence: FloatArray,
    weight: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Sigmas after one step from residuals, and the ratio of mean and mode of each variance."""
    # Variance components by restricted maximum likelihood (Patterson and Thompson, 1971;
    # Foerstner's form): sums of squared residuals over their redundancy. Expected sigmas count as
    # `weight` residuals each.
    weights = _information(problem, at, noise, influence)
    equations = problem.normal_equations(at, weights)
    seen, wall = problem.predicted_variance(at, equations)
    counted = influence > 0.5
    # What of each residual is noise: not explained by the solution.
    left = 1.0 - weights.seen * seen, 1.0 - weights.wall * wall
    seen_variance, wall_variance = _variances(problem, noise)
    measured = counted[problem.landmark]
    groups = [
        *zip(at.seen.T, seen_variance.T, weights.seen.T, left[0].T, [measured] * 2, strict=True),
        (at.wall, wall_variance, weights.wall, left[1], counted & problem.on_wall),
    ]
    squares, counts = np.zeros((2, len(noise)))
    for k, (*parts, who) in enumerate(groups):
        residual, variance, trust, free = (part[who] for part in parts)
        squares[k] = np.sum(trust * residual**2 * noise[k] ** 2 / variance)
        counts[k] = np.sum(np.maximum(free, 0.0) * noise[k] ** 2 / variance)
    squares[_SPREAD], counts[_SPREAD] = problem.spread_misfit(at.shared, equations, noise[_SPREAD])
    pull = weight * (expected / noise) ** 2
    better = noise * np.sqrt((squares + pull) / (counts + weight))
    fewness = 1.0 + 2.0 * counts / (counts + weight) ** 2
    # Panoramas that agree may all be wrong by what they share: papers, floor and camera.
    as_given = _PLACES[better[_PLACES] < 1.0]
    better[as_given] = fewness[as_given] = 1.0
    return better, fewness
