"""
Joint least squares of landmarks and panorama poses: a small bundle adjustment.

What landmarks share (the pose errors of the panoramas) is kept apart from what each has alone,
so that the map can say both. How precise panoramas, papers and walls are, and how differently
things hang, is estimated from the residuals themselves, room by room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment.config import AdjustmentConfig
from landmark_nav.learning.adjustment.problem import Linearized, Problem, wall_stretches
from landmark_nav.learning.least_squares import Damping, root_of
from landmark_nav.learning.stereo.ties import Ties
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement
from landmark_nav.types import FloatArray, Panorama

_MAX_ITERATIONS = 15
# What moves by less is at rest; no landmark goes farther in one step, metres.
_CONVERGED, _LONGEST_M = 1e-7, 1.0
# Squared misfit at which a landmark's weight has fallen to a quarter, at first and in the end.
_TAIL_WIDTH_AT_FIRST, _TAIL_WIDTH = 100.0, 6.0
# A landmark that misses by more than this probability allows does not affect what is shared.
_OUTLIER_PROBABILITY = 0.01
_NO_INFLUENCE = 1e-6
# What misses by more sigmas than this is taken to be less certain, until it does not.
_TAIL_SIGMAS = 2.5
_NOISE_ITERATIONS = 60
_NOISE_CONVERGED = 1e-3
# Factors that landmarks have in common; what the others hold is below a tenth of a millimetre.
_MOST_FACTORS = 16
# So far from where it starts a patch on its own plane may be.
_NO_WALL_M = 1.0
# Among the sigmas that are estimated.
_RELIEF, _SPREAD, _HANGING = 2, slice(3, 8), slice(5, 8)
_PLACES = np.array([3, 4])


@dataclass(frozen=True, eq=False)
class Adjustment:
    """
    Landmarks and panoramas after the adjustment.

    Parameters
    ----------
    positions : ndarray, shape (n, 3)
        Landmarks in map, metres.
    own_covariance : ndarray, shape (n, 3, 3)
        What the error of each has alone.
    shared_loading : ndarray, shape (n, 3, m)
        The rest, as unit-variance factors that all have in common.
    poses, pose_covariance : ndarray, shape (views, 4), (views, 4, 4)
        x, y, z, heading of the panoramas.
    off_wall_m : ndarray, shape (n,)
        How far before its wall each landmark lies.
    chi_square : ndarray, shape (n,)
        Misfit of its measurements and its wall.
    noise : ndarray, shape (8,)
        Sigmas found: of azimuths, of tangents, of relief; factors, 1 or more, on the sigmas that
        panoramas say their places have, in plan and in height; how far things hang off all walls,
        how far each wall lies from where the room says, and how differently far things hang.
    calibration, calibration_covariance : ndarray, shape (c,), (c, c)
        Values of `CALIBRATED`; none where a panorama does not say what it was made with.
    calibration_loading : ndarray, shape (c, m)
        How the factors of `shared_loading` move them.
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
        """How differently far from their walls things hang."""
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
    Adjust landmarks and panorama poses to all measurements.

    Parameters
    ----------
    measurements : sequence of sequences
        For each of n landmarks, where the panoramas show it.
    walls : sequence of int
        Wall of each landmark; -1 for those that hang on none.
    start : ndarray, shape (n, 3)
        Positions to start from.
    panoramas : sequence of Panorama
        With prior poses.
    places : ndarray, shape (4 * views, 4 * views)
        Joint covariance of these, as `reference_area.joint_covariance` gives it.
    room : Room
        The walls; what hangs on them lies near them, not on them.
    normals : ndarray, shape (n, 3), optional
        Of the landmarks; those on walls have that of their wall.
    ties : Ties, optional
        What else panoramas share: it is no landmark, but joins them.
    """
    if normals is None:
        normals = room.normals[np.asarray(walls, dtype=np.intp)]
    count = len(start)
    if ties is not None:
        measurements = [*measurements, *ties.measurements]
        walls = [*walls, *[-1] * len(ties.positions)]
        start = np.concatenate([start, ties.positions])
        normals = np.concatenate([normals, np.tile([1.0, 0.0, 0.0], (len(ties.positions), 1))])
    stretch = wall_stretches(start, walls, room, config.hanging_length_m)
    problem = Problem(
        measurements, walls, stretch, panoramas, places, room, normals, start,
        config.tilt_sigma_rad, config.wave_sigma_rad,
    )  # fmt: skip
    expected = np.array(
        [
            config.azimuth_sigma_rad,
            config.tangent_sigma,
            config.relief_sigma_m,
            *(1.0, 1.0),
            config.common_hanging_sigma_m,
            config.wall_sigma_m,
            config.hanging_sigma_m,
        ]
    )
    points, shared = _settle(problem, start, expected)
    trusted = _misfit(problem, problem.linearize(points, shared), expected) < _bound(problem)
    influence = np.where(trusted, 1.0, _NO_INFLUENCE)
    weight = np.full(len(expected), config.camera_weight)
    weight[_PLACES] = config.place_weight
    weight[_HANGING] = config.room_weight
    noise, damping = expected, Damping()
    for _ in range(_NOISE_ITERATIONS):
        at = problem.linearize(points, shared)
        weights = (*_information(problem, at, noise, influence), noise[_SPREAD])
        points, shared, moved = _step(problem, at, points, shared, weights, damping)
        better, fewness = _noise(problem, points, shared, noise, expected, influence, weight)
        still = np.abs(better / noise - 1.0).max() < _NOISE_CONVERGED
        noise = better
        if still and moved < _CONVERGED:
            break
    # The fewer residuals a variance is estimated from, the farther is its mean from its likeliest
    # value.
    noise = noise * np.sqrt(fewness)
    at = problem.linearize(points, shared)
    equations = problem.normal_equations(
        at, shared, *_information(problem, at, noise, influence), noise[_SPREAD]
    )
    covariance = equations.shared_covariance()
    root = root_of(covariance)
    shared_loading, rest, axes = _main_factors((-equations.gain @ root)[:count])
    return Adjustment(
        points[:count],
        (influence[:, None, None] * equations.own_covariance())[:count] + rest,
        shared_loading,
        problem.poses(shared),
        problem.pose_covariance(covariance),
        problem.off_wall(points)[:count],
        _misfit(problem, at, noise, trusted)[:count],
        noise,
        *problem.calibration(shared, covariance),
        problem.calibration_rows(root) @ axes,
    )


def _settle(
    problem: Problem, start: FloatArray, sigma: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Landmarks (n, 3) and shared unknowns (m,) that most landmarks agree on."""
    points, shared, damping = start.copy(), problem.prior, Damping()
    for step in range(_MAX_ITERATIONS):
        # False matches, and what hangs off the walls, must bend neither their neighbours nor the
        # poses, even where they are many: a weight that falls faster than the pull grows (Geman
        # and McClure, 1987), stricter with each step, as the poses explain more of the misfit.
        tail_width = max(_TAIL_WIDTH_AT_FIRST / 2**step, _TAIL_WIDTH)
        at = problem.linearize(points, shared)
        weight = (1.0 + _misfit(problem, at, sigma) / tail_width) ** -2.0
        seen, wall = _variances(problem, sigma)
        weights = (weight[problem.landmark, None] / seen, weight / wall, sigma[_SPREAD])
        points, shared, moved = _step(problem, at, points, shared, weights, damping)
        if step > 4 and moved < _CONVERGED:
            break
    return points, shared


def _step(
    problem: Problem,
    at: Linearized,
    points: FloatArray,
    shared: FloatArray,
    weights: tuple[FloatArray, FloatArray, FloatArray],
    damping: Damping,
) -> tuple[FloatArray, FloatArray, float]:
    """
    Landmarks and shared unknowns one step farther, and the farthest that one of them moved.

    `weights` are those of `Problem.normal_equations`; no landmark moves farther than what is
    linear.
    """
    equations = problem.normal_equations(at, shared, *weights)
    there = points, shared

    def cost_with(by: float) -> float:
        nonlocal there
        point_step, shared_step = equations.damped(by).solve()
        length = np.linalg.norm(point_step, axis=1, keepdims=True)
        point_step = point_step * np.minimum(1.0, _LONGEST_M / np.maximum(length, _LONGEST_M))
        there = points + point_step, shared + shared_step
        return problem.cost(problem.linearize(*there), there[1], *weights)

    if not damping.lowers(cost_with, problem.cost(at, shared, *weights)):
        return points, shared, 0.0
    moved = max(np.abs(new - old).max() for new, old in zip(there, (points, shared), strict=True))
    return *there, float(moved)


def _main_factors(loading: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Loadings (n, 3, m) by fewer factors (n, 3, f), what is left of the covariances (n, 3, 3).

    Also the axes (m, f) of these factors.

    Poses and walls move many landmarks; how one poster hangs moves its own by a tenth of that.
    """
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
    """Share of its information that a residual keeps."""
    with np.errstate(divide='ignore'):
        return np.asarray(np.minimum(1.0, _TAIL_SIGMAS**2 * variance / residual**2))


def _information(
    problem: Problem, at: Linearized, noise: FloatArray, influence: FloatArray
) -> tuple[FloatArray, FloatArray]:
    seen, wall = _variances(problem, noise)
    return (
        influence[problem.landmark, None] * _tail(at.seen, seen) / seen,
        influence * _tail(at.wall, wall) / wall,
    )


def _misfit(
    problem: Problem,
    at: Linearized,
    noise: FloatArray,
    trusted: npt.NDArray[np.bool_] | bool = False,
) -> FloatArray:
    """Squared misfit of each landmark (n,); those `trusted` may hang off in the tail."""
    seen, wall = _variances(problem, noise)
    share = np.where(trusted, _tail(at.wall, wall), 1.0)
    sums = np.bincount(problem.landmark, np.sum(at.seen**2 / seen, 1), problem.count)
    return np.asarray(sums + share * at.wall**2 / wall)


def _bound(problem: Problem) -> FloatArray:
    """Largest misfit (n,) of what is no outlier: a place takes three of the numbers seen."""
    freedom = 2 * np.bincount(problem.landmark, minlength=problem.count) + 1 - 3
    return np.asarray(chdtri(freedom, _OUTLIER_PROBABILITY))


def _noise(
    problem: Problem,
    points: FloatArray,
    shared: FloatArray,
    noise: FloatArray,
    expected: FloatArray,
    influence: FloatArray,
    weight: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """
    Sigmas that the residuals show, one step nearer.

    Variance components by restricted maximum likelihood (Patterson and Thompson, 1971;
    Foerstner's form): squared residuals count against their redundancy, which is what the
    unknowns did not take from them. Expected sigmas join in as `weight` residuals each. Returned
    with the mean of each variance, given how many it is estimated from, over its likeliest value.
    """
    at = problem.linearize(points, shared)
    information = _information(problem, at, noise, influence)
    equations = problem.normal_equations(at, shared, *information, noise[_SPREAD])
    predicted = problem.predicted_variance(at, equations)
    counted = influence > 0.5
    seen_voice = counted[problem.landmark]
    variances = _variances(problem, noise)
    groups = [
        (at.seen[:, 0], variances[0][:, 0], information[0][:, 0], predicted[0][:, 0], seen_voice),
        (at.seen[:, 1], variances[0][:, 1], information[0][:, 1], predicted[0][:, 1], seen_voice),
        (at.wall, variances[1], information[1], predicted[1], counted & problem.on_wall),
    ]
    squares, counts = np.zeros((2, len(noise)))
    for k, (residual, variance, trust, explained, who) in enumerate(groups):
        part = noise[k] ** 2 / variance[who]
        squares[k] = np.sum((trust * residual**2)[who] * part)
        counts[k] = np.sum(np.maximum(1.0 - trust * explained, 0.0)[who] * part)
    squares[_SPREAD], counts[_SPREAD] = problem.spread_misfit(shared, equations, noise[_SPREAD])
    pull = weight * (expected / noise) ** 2
    better = noise * np.sqrt((squares + pull) / (counts + weight))
    fewness = 1.0 + 2.0 * counts / (counts + weight) ** 2
    # Panoramas that agree may all be wrong by what they share: papers, floor and camera.
    as_given = _PLACES[better[_PLACES] < 1.0]
    better[as_given] = fewness[as_given] = 1.0
    return better, fewness
