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
from landmark_nav.geometry.se2 import cross, rot_z
from landmark_nav.learning.least_squares import covariance_of, levenberg_marquardt, root_of
from landmark_nav.parameters import Config
from landmark_nav.types import FloatArray


@dataclass(frozen=True)
class RelativePoseConfig(Config):
    """Matching of features between panoramas, and acceptance of a relative pose."""

    # Most features per panorama.
    features: int = 6000
    # Greatest distance of a match in descriptor space, relative to that of the next best.
    max_ratio: float = 0.85
    # Sigma of the direction of a feature, with the errors of the panorama.
    direction_sigma_rad: float = 1.5e-3
    # Sigma of the direction of a feature in a panorama without errors.
    feature_sigma_rad: float = 5e-4
    # Sigma of a sweep's tilt, about x and y.
    tilt_sigma_rad: float = 0.01
    # Prior sigma of the height of a sweep. With a smaller one, a false tilt replaces a height.
    rise_sigma_m: float = 0.02
    # Sigma of the pan zero, which all sweeps share, beyond that of the robot file.
    heading_sigma_rad: float = 1e-3
    # Fewest matches that support a relative pose.
    min_matches: int = 20
    # Greatest sigma of the heading of a sweep by the scatter of its matches: beyond it patches are
    # not found again.
    max_doubt_rad: float = 0.0175


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
    roll, pitch = state[4], state[5]
    tilt = np.array([[1.0, 0.0, pitch], [0.0, 1.0, -roll], [-pitch, roll, 1.0]])
    return np.asarray(rays @ tilt.T @ rot_z(state[2]).T)


def center(states: FloatArray) -> FloatArray:
    """Viewpoints (..., 3) of states (..., 6) of sweeps."""
    return np.asarray(states[..., [0, 1, 3]])


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
    state, other = states[pairs.one], states[pairs.other]
    w, v = turned(state, pairs.rays), turned(other, pairs.other_rays)
    way = center(other) - center(state)
    normal = np.cross(w, v)
    off = normal @ way
    by_w, by_v = np.cross(v, way), np.cross(way, w)
    # Azimuth and tangent of both rays have the same sigma.
    variance = sum(
        np.sum(by * across, 1) ** 2 + by[:, 2] ** 2
        for by, across in ((by_w, _across(w)), (by_v, _across(v)))
    )
    scale = 1.0 / (sigma_rad * np.sqrt(variance) + _NOTHING)
    # The length of the baseline has no effect.
    normal -= np.outer(off / max(float(way @ way), _NOTHING), way)
    jacobian = np.empty((len(w), 2, STATE))
    for k, (at, by, ray, sign) in enumerate(((state, by_w, w, -1.0), (other, by_v, v, 1.0))):
        turn = np.cross(ray, by)
        jacobian[:, k, :2] = sign * normal[:, :2]
        jacobian[:, k, 2] = turn[:, 2]
        jacobian[:, k, 3] = sign * normal[:, 2]
        jacobian[:, k, 4:] = (turn @ rot_z(at[2]))[:, :2]
    # In plan: whether the rays meet ahead of both.
    parallax = cross(w, v)
    before = (parallax * cross(way, v) > 0.0) & (parallax * cross(way, w) > 0.0)
    before &= np.abs(parallax) > _LEAST_PARALLAX
    return off * scale, jacobian * scale[:, None, None], before


def evidence(off: FloatArray, band: float) -> float:
    """
    Log-likelihood ratio of a pose to chance by the residuals (m,) of matches, in sigmas.

    Matches by chance are uniform within the band, others have a normal distribution; their share
    is the most likely one.
    """
    density = np.exp(-0.5 * off**2) / np.sqrt(2.0 * np.pi)
    ratio = np.multiply.outer(2.0 * band * density - 1.0, _SHARES)
    return float(np.log1p(ratio).sum(axis=0).max())


def _across(rays: FloatArray) -> FloatArray:
    return np.stack([-rays[:, 1], rays[:, 0], np.zeros(len(rays))], 1)


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
    views = len(start)
    whiten = np.linalg.inv(root_of(prior_covariance))
    states, information = start, np.eye(STATE * views)

    def off_prior(state: FloatArray) -> FloatArray:
        off = state - prior
        off[:, 2] = wrap_rad(off[:, 2])
        return np.asarray(whiten @ off.ravel())

    for width in np.geomspace(first_width, TAIL, _STEPS):
        found = [misses(states, p, sigma_rad) for p in pairs]
        weights = [
            np.where(before, 1.0, 1e-3) / (1.0 + (off / width) ** 2) for off, _, before in found
        ]

        def linearize(flat: FloatArray) -> tuple[FloatArray, FloatArray]:
            at = flat.reshape(views, STATE)
            rows, slopes = [off_prior(at)], [whiten]
            if others is not None:
                off, jacobian = others(at)
                rows.append(off)
                slopes.append(jacobian)
            for p, weight in zip(pairs, weights, strict=True):  # noqa: B023
                off, jacobian, _ = misses(at, p, sigma_rad)
                slope = np.zeros((len(off), views, STATE))
                slope[:, p.one], slope[:, p.other] = jacobian[:, 0], jacobian[:, 1]
                rows.append(weight * off)
                slopes.append(weight[:, None] * slope.reshape(len(off), -1))
            return np.concatenate(rows), np.concatenate(slopes)

        flat, _, information = levenberg_marquardt(linearize, states.ravel())
        states = flat.reshape(views, STATE)
    agrees = []
    for p in pairs:
        off, _, before = misses(states, p, sigma_rad)
        agrees.append(before & (np.abs(off) < _AGREES))
    return EpipolarFit(states, covariance_of(information), tuple(agrees))
