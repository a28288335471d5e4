"""
Poses of sweeps from epipolar constraints between their panoramas.

Two rays to one point and the baseline lie in one plane: ``b . (w1 x w2) = 0`` (McMillan and
Bishop, SIGGRAPH 1995). Points are eliminated: only poses are unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from landmark_nav.arrays import BoolArray
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import rot_z
from landmark_nav.learning.least_squares import covariance_of, Equations, levenberg_marquardt
from landmark_nav.types import FloatArray

# Sigma of the direction of a feature, with the errors of the panorama and without them, rad.
DIRECTION_SIGMA_RAD, FEATURE_SIGMA_RAD = 1.5e-3, 5e-4
# Sigma of a sweep's tilt, about x and y, rad; prior sigma of its height, m. With a smaller one, a
# false tilt replaces a height.
TILT_SIGMA_RAD, RISE_SIGMA_M = 0.01, 0.02
# State of a sweep: x, y of the pan axis, heading of the base, height of the viewpoint, tilt about
# x and y.
STATE = 6
# Scale of the robust weight, in sigmas, in the first and the last step; number of steps.
_WIDE_TAIL, TAIL, _STEPS = 16.0, 2.0, 6
# Greatest residual of an inlier, in sigmas, and its least parallax.
_AGREES, _LEAST_PARALLAX = 3.0, 1e-4
_NOTHING = 1e-12
# Shares of right matches that are tried.
_SHARES = np.linspace(0.0, 0.95, 20)


@dataclass(frozen=True, eq=False)
class RayPairs:
    """Matches between the views `one` and `other`: rays (m, 3) of each in its base frame."""

    one: int
    other: int
    rays: FloatArray
    other_rays: FloatArray

    def chosen(self, which: BoolArray) -> RayPairs:
        """Return the matches selected by `which` (m,)."""
        return RayPairs(self.one, self.other, self.rays[which], self.other_rays[which])


@dataclass(frozen=True, eq=False)
class EpipolarFit:
    """States (v, 6) of sweeps, their covariance (6 v, 6 v), and the inliers of each pair."""

    states: FloatArray
    covariance: FloatArray
    agrees: tuple[BoolArray, ...]


def turned(state: FloatArray, rays: FloatArray) -> FloatArray:
    """Rotate rays (m, 3) from the base frame to map, by the state (6,); tilts are small."""
    return np.asarray(rays @ _turn(state).T)


def _turn(state: FloatArray) -> FloatArray:
    roll, pitch = state[4], state[5]
    tilt = np.array([[1.0, 0.0, pitch], [0.0, 1.0, -roll], [-pitch, roll, 1.0]])
    return np.asarray(rot_z(float(state[2])) @ tilt)


def center(states: FloatArray) -> FloatArray:
    """Viewpoints (..., 3) of states (..., 6) of sweeps."""
    return np.asarray(states[..., [0, 1, 3]])


def residuals(
    states: FloatArray, pairs: RayPairs, sigma_rad: float
) -> tuple[FloatArray, BoolArray]:
    """Residuals (m,) of matches and whether the rays meet (m,), as `misses`."""
    planes = _Planes(states, pairs)
    return planes.off * planes.scale(sigma_rad), planes.before


def misses(
    states: FloatArray, pairs: RayPairs, sigma_rad: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """
    Residuals of matches in sigmas (Sampson's approximation).

    Returns
    -------
    misses : ndarray, shape (m,)
    jacobian : ndarray, shape (m, 2, 6)
        Derivatives by the states of both views.
    before : ndarray of bool, shape (m,)
        Whether the rays meet in front of both viewpoints.
    """
    planes, scale = (at := _Planes(states, pairs)), at.scale(sigma_rad)
    way = planes.way
    # The length of the baseline has no effect.
    normal = planes.normal - np.outer(way, planes.off / max(float(way @ way), _NOTHING))
    jacobian = np.empty((2, STATE, len(scale)))
    sides = ((pairs.one, planes.w, planes.by_w), (pairs.other, planes.v, planes.by_v))
    for by_state, (view, ray, by_ray), sign in zip(jacobian, sides, (-1.0, 1.0), strict=True):
        turn = _cross(ray, by_ray)
        by_state[:2], by_state[3] = sign * normal[:2], sign * normal[2]
        by_state[2], by_state[4:] = turn[2], rot_z(states[view, 2])[:2, :2].T @ turn[:2]
    return planes.off * scale, (jacobian * scale).transpose(2, 0, 1), planes.before


class _Planes:
    """
    Rays `w` and `v` (3, m) of matches in map, and the baseline `way` (3,).

    `off` (m,) are their triple products ``way . (w x v)``, `normal`, `by_w` and `by_v` (3, m) the
    derivatives by baseline and rays; `before` (m,) is whether the rays meet ahead of both views.
    """

    def __init__(self, states: FloatArray, pairs: RayPairs) -> None:
        state, other = states[pairs.one], states[pairs.other]
        self.w, self.v = _turn(state) @ pairs.rays.T, _turn(other) @ pairs.other_rays.T
        self.way = center(other) - center(state)
        self.normal = _cross(self.w, self.v)
        self.off = self.way @ self.normal
        self.by_w, self.by_v = _cross(self.v, self.way), _cross(self.way, self.w)
        parallax = self.normal[2]
        self.before = (parallax * self.by_w[2] < 0.0) & (parallax * self.by_v[2] > 0.0)
        self.before &= np.abs(parallax) > _LEAST_PARALLAX

    def scale(self, sigma_rad: float) -> FloatArray:
        """Reciprocal sigmas (m,) of `off`: azimuth and tangent of both rays have the same."""
        variance = self.by_w[2] ** 2 + self.by_v[2] ** 2
        for ray, by_ray in ((self.w, self.by_w), (self.v, self.by_v)):
            variance += (ray[0] * by_ray[1] - ray[1] * by_ray[0]) ** 2
        return np.asarray(1.0 / (sigma_rad * np.sqrt(variance) + _NOTHING))


def _cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """Cross products (3, m) of vectors (3, m) or (3,); `numpy.cross` takes much longer."""
    (a, b, c), (d, e, f) = first, second
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


def evidence(off: FloatArray, band: float | FloatArray) -> float:
    """
    Log-likelihood ratio to chance by residuals (m,) within a band of this half width, in sigmas.

    Those by chance are uniform within the band, others have a normal distribution; their share is
    the most likely one.
    """
    density = np.exp(-0.5 * off**2) / np.sqrt(2.0 * np.pi)
    ratio = np.multiply.outer(2.0 * band * density - 1.0, _SHARES)
    return float(np.log1p(ratio).sum(axis=0).max())


def fit_poses(
    start: FloatArray,
    pairs: Sequence[RayPairs],
    sigma_rad: float,
    prior: FloatArray,
    prior_covariance: FloatArray,
    others: Callable[[FloatArray], tuple[FloatArray, FloatArray]] | None = None,
    first_width: float = _WIDE_TAIL,
) -> EpipolarFit:
    """
    Robust fit of the states of sweeps to matches and a prior.

    The weight is that of Geman and McClure, with a scale that decreases from step to step.

    Parameters
    ----------
    start : ndarray, shape (v, 6)
        Initial states.
    pairs : sequence of RayPairs
        Matches between views.
    sigma_rad : float
        Sigma of the direction of a ray.
    prior, prior_covariance : ndarray, shape (v, 6), (6 v, 6 v)
        Prior of the states.
    others : callable, optional
        Other measurements: residuals (m,) in sigmas at states (v, 6), and their derivatives
        (m, 6 v).
    first_width : float
        Scale of the robust weight in the first step, in sigmas.
    """
    known = covariance_of(prior_covariance)
    states, information = start, known
    for width in np.geomspace(first_width, TAIL, _STEPS):
        weights = []
        for p in pairs:
            off, before = residuals(states, p, sigma_rad)
            weights.append((np.where(before, 1.0, 1e-3) / (1.0 + (off / width) ** 2)) ** 2)

        def equations(flat: FloatArray) -> Equations:
            at = flat.reshape(start.shape)
            off = at - prior
            off[:, 2] = wrap_rad(off[:, 2])
            pull = known @ off.ravel()
            cost, matrix = float(off.ravel() @ pull), known.copy()
            if others is not None:
                off, jacobian = others(at)
                cost, pull = cost + float(off @ off), pull + jacobian.T @ off
                matrix += jacobian.T @ jacobian
            for p, weight in zip(pairs, weights, strict=True):  # noqa: B023
                off, slope, _ = misses(at, p, sigma_rad)
                slope = slope.reshape(len(off), 2 * STATE)
                both = np.ravel(STATE * np.array([[p.one], [p.other]]) + np.arange(STATE))
                cost += float(weight @ off**2)
                pull[both] += (weight * off) @ slope
                matrix[np.ix_(both, both)] += (slope.T * weight) @ slope
            return cost, pull, matrix

        flat, _, information = levenberg_marquardt(equations, states.ravel())
        states = flat.reshape(start.shape)
    agrees = []
    for p in pairs:
        off, before = residuals(states, p, sigma_rad)
        agrees.append(before & (np.abs(off) < _AGREES))
    return EpipolarFit(states, covariance_of(information), tuple(agrees))
