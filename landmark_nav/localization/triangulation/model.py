"""
The bearing model: what a landmark's bearing is, how it changes, and the pan axis' lever arm.

Bearings are seen from the pan axis, counter-clockwise from ``base_link`` +x, so a bearing's pose
is that of the axis with the orientation of the base.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import compose, compose_jacobians
from landmark_nav.types import FloatArray, PoseEstimate

__all__ = [
    'axis_from_base',
    'base_from_axis',
    'bearing_gradients',
    'bearing_residuals',
    'danger_distance',
    'map_share',
    'triples',
]


def bearing_residuals(
    poses: npt.ArrayLike, positions: npt.ArrayLike, bearings: npt.ArrayLike
) -> FloatArray:
    """
    Measured minus expected bearing, wrapped to (-pi, pi].

    Parameters
    ----------
    poses : array_like, shape (..., 3)
        Poses of the pan axis in map.
    positions : array_like, shape (..., n, 2)
        Landmarks in map, metres.
    bearings : array_like, shape (..., n)
        Measured bearings, radians.

    Returns
    -------
    ndarray, shape (..., n)
        About pi where a closed form met the bearing's opposite: the modulo-pi ambiguity.

    """
    pose = np.asarray(poses, dtype=np.float64)[..., None, :]
    delta = np.asarray(positions, dtype=np.float64) - pose[..., :2]
    azimuth = np.arctan2(delta[..., 1], delta[..., 0])
    return wrap_rad(np.asarray(bearings, dtype=np.float64) - azimuth + pose[..., 2])


def bearing_gradients(pose: npt.ArrayLike, positions: npt.ArrayLike) -> FloatArray:
    """
    Derivative (..., n, 2) of the bearings to landmarks (..., n, 2) by the axis' x and y.

    The derivative by heading is -1, the one by the landmark's x and y is the opposite.
    """
    center = np.asarray(pose, dtype=np.float64)[..., None, :2]
    delta = np.asarray(positions, dtype=np.float64) - center
    x, y = delta[..., 0], delta[..., 1]
    # Filled in, not stacked: most calls are for a few landmarks, and many.
    gradients = np.empty_like(delta)
    gradients[..., 0], gradients[..., 1] = y, -x
    # On a landmark, to a micrometre, there is no bearing.
    gradients /= np.maximum(x * x + y * y, 1e-12)[..., None]
    return gradients


def map_share(gradients: FloatArray, covariance: FloatArray) -> FloatArray:
    """
    Covariance (n, n) that the landmarks' joint covariance (2n, 2n) gives to n bearings.

    It is G Sigma_L G^T with G the block diagonal of minus the bearing `gradients` (n, 2).
    """
    n = len(gradients)
    by_landmarks = (gradients[:, None] @ covariance.reshape(n, 2, 2 * n)).reshape(n, n, 2)
    return np.asarray((by_landmarks * gradients).sum(axis=-1))


def danger_distance(point: npt.ArrayLike, landmarks: npt.ArrayLike) -> tuple[float, float]:
    """
    Distance of a point from the circle through three landmarks, where bearings fix nothing.

    Everything is finite for collinear landmarks too, whose circle is their line.

    Parameters
    ----------
    point : array_like, shape (2,)
        Metres.
    landmarks : array_like, shape (3, 2)
        Metres.

    Returns
    -------
    distance : float
        From the circle or line, metres.
    relative : float
        The same over the circle's radius or the farthest landmark's range, the smaller of them.

    """
    delta = np.asarray(landmarks, dtype=np.float64) - np.asarray(point, dtype=np.float64)
    square = np.sum(delta * delta, -1)
    first, last = delta[1] - delta[0], delta[2] - delta[0]
    double_area = first[0] * last[1] - first[1] * last[0]
    # Twice the signed area times the power of the point: minus the in-circle determinant.
    power = -np.linalg.det(np.column_stack([delta, square]))
    sides = np.linalg.norm([first, last, delta[2] - delta[1]], axis=1)
    half_product = 0.5 * np.prod(sides)  # twice the area times the radius
    center = np.sqrt(max(half_product**2 + double_area * power, 0.0))
    distance = abs(power) / max(center + half_product, 1e-300)
    curvature = abs(double_area) / max(half_product, 1e-300)
    return float(distance), float(distance * max(curvature, 1.0 / np.sqrt(square.max())))


@lru_cache(maxsize=256)
def triples(n: int, limit: int) -> npt.NDArray[np.intp]:
    """Index triples (m, 3) out of n, evenly thinned to `limit`."""
    found = np.array(list(combinations(range(n), 3)), dtype=np.intp).reshape(-1, 3)
    if len(found) > limit:
        found = found[np.linspace(0, len(found) - 1, limit).astype(np.intp)]
    found.flags.writeable = False  # it is remembered
    return found


def axis_from_base(estimate: PoseEstimate, mount: PanTiltMount) -> PoseEstimate:
    """Pose of the pan axis, with the orientation of the base, from the pose of the base."""
    return _shifted(estimate, np.array([*mount.axis_xyz[:2], 0.0]))


def base_from_axis(estimate: PoseEstimate, mount: PanTiltMount) -> PoseEstimate:
    """Pose of the base from the pose of the pan axis with the orientation of the base."""
    return _shifted(estimate, -np.array([*mount.axis_xyz[:2], 0.0]))


def _shifted(estimate: PoseEstimate, lever: FloatArray) -> PoseEstimate:
    by_pose, _ = compose_jacobians(estimate.pose, lever)
    covariance = by_pose @ estimate.covariance @ by_pose.T
    return PoseEstimate(estimate.stamp_ns, compose(estimate.pose, lever), covariance)
