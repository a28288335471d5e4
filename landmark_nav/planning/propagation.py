"""
Errors to first order: from panoramas' poses to landmarks, from landmarks to the robot's place.

The models are those of `learning.adjustment` (what a landmark's error has alone, and what the
panoramas' poses give to all) and of bearings to everything that a turning camera sees, in
plan. Landmarks come in expected numbers, which scale their information.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from landmark_nav.learning.adjustment import AdjustmentConfig
from landmark_nav.types import FloatArray

__all__ = ['landmark_errors', 'localization_sigma']

# x, y, heading of each panorama; after all of them, how far things hang off each wall.
_POSE = 3

# Landmarks that a fix needs.
_LEAST_SEEN = 3.0


def landmark_errors(
    azimuth_rad: FloatArray,
    range_m: FloatArray,
    weight: FloatArray,
    normal: FloatArray,
    wall: npt.NDArray[np.intp],
    landmarks: FloatArray,
    pose_covariance: FloatArray,
    config: AdjustmentConfig,
) -> tuple[FloatArray, FloatArray]:
    """
    Errors of landmarks on walls that n panoramas show and an adjustment places.

    Parameters
    ----------
    azimuth_rad, range_m : ndarray, shape (n, s)
        Of s points on walls from the panoramas, in map.
    weight : ndarray, shape (n, s)
        Information of each measurement, 1 / rad^2; 0 where there is none.
    normal : ndarray, shape (s, 2)
        Of the walls.
    wall : ndarray of int, shape (s,)
        Which wall each is on.
    landmarks : ndarray, shape (s,)
        How many there are at each point.
    pose_covariance : ndarray, shape (3 n, 3 n)
        Joint one of x, y and heading of the panoramas, before the adjustment.
    config : AdjustmentConfig
        How exactly things hang on walls.

    Returns
    -------
    own : ndarray, shape (s, 2, 2)
        Covariance of what a landmark's error has alone.
    loading : ndarray, shape (s, 2, m)
        The rest, as unit-variance factors that all have in common.

    """
    # Of azimuths by the landmark; by the panorama it is the opposite, by heading -1.
    turned = azimuth_rad + 0.5 * np.pi
    by_point = np.stack([np.cos(turned), np.sin(turned)], -1) / range_m[..., None]
    by_pose = np.concatenate([-by_point, np.full((*range_m.shape, 1), -1.0)], -1)
    hanging = 1.0 / (config.hanging_sigma_m**2 + config.relief_sigma_m**2)
    h_xx = np.einsum('ns,nsi,nsj->sij', weight, by_point, by_point)
    h_xx += hanging * normal[:, :, None] * normal[:, None]
    # Nothing is known along the wall where no panorama looks: 30 m are as good as nothing.
    h_xx += 1e-3 * np.eye(2)
    h_xp = np.einsum('ns,nsi,nsj->sinj', weight, by_point, by_pose)
    on_wall = np.eye(int(wall.max()) + 1)[wall]
    h_xw = -hanging * normal[..., None] * on_wall[:, None]
    h_xs = np.concatenate([h_xp.reshape(len(normal), 2, -1), h_xw], 2)
    own = np.linalg.inv(h_xx)
    gain = own @ h_xs

    shared = np.zeros((h_xs.shape[2], h_xs.shape[2]))
    blocks = np.einsum('s,ns,nsi,nsj->nij', landmarks, weight, by_pose, by_pose)
    poses, planes = slice(0, _POSE * len(blocks)), slice(_POSE * len(blocks), None)
    shared[poses, poses] = block_diag(*blocks) + np.linalg.inv(pose_covariance)
    off_walls = (
        config.common_hanging_sigma_m**2 + np.eye(on_wall.shape[1]) * config.wall_sigma_m**2
    )
    shared[planes, planes] = np.linalg.inv(off_walls) + hanging * np.diag(landmarks @ on_wall)
    # Schur complement: what is left of the information once every landmark is solved for.
    factors = len(shared)
    reduction = (landmarks[:, None, None] * h_xs).reshape(-1, factors)
    shared -= reduction.T @ gain.reshape(-1, factors)
    return own, gain @ np.linalg.cholesky(np.linalg.inv(shared))


def localization_sigma(
    gradient: FloatArray,
    seen: FloatArray,
    own: FloatArray,
    loading: FloatArray,
    bearing_sigma_rad: float,
) -> FloatArray:
    """
    Localization error from bearings to all landmarks in view.

    Parameters
    ----------
    gradient : ndarray, shape (c, s, 2)
        Of the bearings by the viewer's x and y, at c places.
    seen : ndarray, shape (c, s)
        How many landmarks are seen at each of s points.
    own, loading : ndarray, shape (s, 2, 2), (s, 2, m)
        Their errors, as from `landmark_errors`.
    bearing_sigma_rad : float
        Standard deviation of a bearing.

    Returns
    -------
    ndarray, shape (c,)
        Root of the trace of the position's covariance, metres; inf where fewer than three are
        seen or they fix no place.

    """
    gx, gy = gradient[..., 0], gradient[..., 1]
    variance = gx * gx * own[:, 0, 0] + 2.0 * gx * gy * own[:, 0, 1] + gy * gy * own[:, 1, 1]
    weight = seen / (variance + bearing_sigma_rad**2)
    wx, wy = weight * gx, weight * gy
    wxx, wxy, wyy = wx * gx, wx * gy, wy * gy

    # J^T R^-1 J for J = (g, -1) and R = D + U U^T with U = -g L, by Woodbury's identity.
    xx, xy, yy, x, y, one = (w.sum(axis=1) for w in (wxx, wxy, wyy, wx, wy, weight))
    direct = np.stack([xx, xy, -x, xy, yy, -y, -x, -y, one], -1).reshape(-1, 3, 3)
    lx, ly = loading[:, 0], loading[:, 1]
    cross = np.stack([-(wxx @ lx + wxy @ ly), -(wxy @ lx + wyy @ ly), wx @ lx + wy @ ly], 1)
    # Symmetric: only the upper half is worked out.
    i, j = np.triu_indices(loading.shape[2])
    halves = [lx[:, i] * lx[:, j], lx[:, i] * ly[:, j] + ly[:, i] * lx[:, j], ly[:, i] * ly[:, j]]
    upper = np.concatenate([wxx, wxy, wyy], axis=1) @ np.concatenate(halves)
    shared = np.zeros((len(gx), loading.shape[2], loading.shape[2]))
    shared[:, i, j] = shared[:, j, i] = upper
    shared += np.eye(loading.shape[2])
    information = direct - cross @ np.linalg.solve(shared, np.swapaxes(cross, -1, -2))
    return _position_sigma(information, seen.sum(axis=1) >= _LEAST_SEEN)


def _position_sigma(information: FloatArray, enough: npt.NDArray[np.bool_]) -> FloatArray:
    """Root of the trace (c,) of the position part of inverse information (c, 3, 3)."""
    sigma = np.full(len(information), np.inf)
    # The heading is eliminated first: what remains is 2 x 2.
    turn = np.maximum(information[:, 2, 2], 1e-12)
    arm = information[:, :2, 2]
    plane = information[:, :2, :2] - arm[:, :, None] * arm[:, None] / turn[:, None, None]
    xx, yy = plane[:, 0, 0], plane[:, 1, 1]
    det = xx * yy - plane[:, 0, 1] * plane[:, 1, 0]
    good = enough & (xx > 0.0) & (yy > 0.0)
    good &= det > 1e-9 * xx * yy
    sigma[good] = np.sqrt((xx[good] + yy[good]) / det[good])
    return sigma
