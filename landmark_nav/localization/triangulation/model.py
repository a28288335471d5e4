"""
The bearing model with its derivatives, the pose from three bearings, and least squares.

A bearing is measured at the pan axis, counter-clockwise from ``base_link`` +x. The pose that
belongs to it is that of the axis with the orientation of the base.

Three bearings give the pose in closed form: the power centre of the three circles of constant
angle (Pierlot and Van Droogenbroeck, A New Three Object Triangulation Algorithm for Mobile Robot
Positioning, IEEE T-RO 30(3), 2014, eqs. 21 to 34). Their cotangents become infinite where two
landmarks are 0 or 180 degrees apart. Here each circle is multiplied by the sine of its angle, so
that its centre is a homogeneous point and this case needs no special treatment.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import BoolArray, IndexArray
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import compose, compose_jacobians
from landmark_nav.types import FloatArray, PoseEstimate, Refusal


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
        About pi where a closed form solved for the opposite direction: the modulo-pi ambiguity.
    """
    pose = np.asarray(poses, dtype=np.float64)[..., None, :]
    delta = np.asarray(positions, dtype=np.float64) - pose[..., :2]
    azimuth = np.arctan2(delta[..., 1], delta[..., 0])
    return wrap_rad(np.asarray(bearings, dtype=np.float64) - azimuth + pose[..., 2])


def bearing_gradients(pose: npt.ArrayLike, positions: npt.ArrayLike) -> FloatArray:
    """
    Derivatives (..., n, 2) of the bearings to landmarks (..., n, 2) by x and y of the axis.

    The derivative by the heading is -1; that by x and y of the landmark has the opposite sign.
    """
    center = np.asarray(pose, dtype=np.float64)[..., None, :2]
    delta = np.asarray(positions, dtype=np.float64) - center
    x, y = delta[..., 0], delta[..., 1]
    # np.stack is slower, and calls are many, each for a few landmarks.
    gradients = np.empty_like(delta)
    gradients[..., 0], gradients[..., 1] = y, -x
    # Within a micrometre of a landmark its bearing is undefined.
    gradients /= np.maximum(x * x + y * y, 1e-12)[..., None]
    return gradients


def map_share(gradients: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (n, n) of bearings by that of the landmarks (2n, 2n) and `gradients` (n, 2)."""
    n = len(gradients)
    by_landmarks = (gradients[:, None] @ covariance.reshape(n, 2, 2 * n)).reshape(n, n, 2)
    return np.asarray((by_landmarks * gradients).sum(axis=-1))


def danger_distance(point: npt.ArrayLike, landmarks: npt.ArrayLike) -> tuple[float, float]:
    """
    Distance of a point from the circle through three landmarks, on which no pose can be computed.

    The result is finite for collinear landmarks too, whose circle is their line.

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
        The same over the radius of the circle or the range of the farthest landmark, whichever is
        smaller.
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
    """Index triples (m, 3) out of n, at most `limit`, evenly spaced in the list of all."""
    found = np.array(list(combinations(range(n), 3)), dtype=np.intp).reshape(-1, 3)
    if len(found) > limit:
        found = found[np.linspace(0, len(found) - 1, limit).astype(np.intp)]
    found.flags.writeable = False  # the array is cached
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


# Triplets computed at a time: the intermediate arrays stay in the cache.
_BLOCK = 8192


def triangulate_three(positions: npt.ArrayLike, bearings: npt.ArrayLike) -> FloatArray:
    """
    Poses from three bearings each.

    Parameters
    ----------
    positions : array_like, shape (..., 3, 2)
        Landmarks in map, metres.
    bearings : array_like, shape (..., 3)
        Their bearings, counter-clockwise from the robot's heading, radians.

    Returns
    -------
    ndarray, shape (..., 3)
        x, y [m] and heading [rad]. On the circle through the landmarks (`danger_distance`) the
        pose is undetermined: not finite or, by rounding, arbitrary. The equations also hold for
        the opposite direction of a landmark: check `bearing_residuals` before use.
    """
    position = np.asarray(positions, dtype=np.float64)
    bearing = np.asarray(bearings, dtype=np.float64)
    shape = np.broadcast_shapes(position.shape[:-2], bearing.shape[:-1])
    position = np.broadcast_to(position, (*shape, 3, 2)).reshape(-1, 3, 2)
    bearing = np.broadcast_to(bearing, (*shape, 3)).reshape(-1, 3)
    poses = np.empty((len(bearing), 3))
    for start in range(0, len(bearing), _BLOCK):
        block = slice(start, start + _BLOCK)
        poses[block] = _power_center(position[block], bearing[block])
    return poses.reshape((*shape, 3))


def _power_center(position: FloatArray, bearing: FloatArray) -> FloatArray:
    """Poses (m, 3) from landmarks (m, 3, 2) and bearings (m, 3)."""
    (x1, y1), (x2, y2), (x3, y3) = (np.ascontiguousarray(p.T) for p in np.moveaxis(position, 1, 0))
    b1, b2, b3 = np.ascontiguousarray(bearing.T)
    b12, b23 = b2 - b1, b3 - b2
    c12, s12, c23, s23 = np.cos(b12), np.sin(b12), np.cos(b23), np.sin(b23)
    c31, s31 = c12 * c23 - s12 * s23, -(s12 * c23 + c12 * s23)

    # Landmarks 1 and 3 as seen from 2, the circles' homogeneous centres, and the power k31.
    xa, ya, xc, yc = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    x12, y12 = s12 * xa + c12 * ya, s12 * ya - c12 * xa
    x23, y23 = s23 * xc - c23 * yc, s23 * yc + c23 * xc
    x31 = s31 * (xc + xa) + c31 * (yc - ya)
    y31 = s31 * (yc + ya) - c31 * (xc - xa)
    k31 = s31 * (xa * xc + ya * yc) + c31 * (xa * yc - xc * ya)

    normal_x, normal_y = y12 * s23 - y23 * s12, x23 * s12 - x12 * s23
    determinant = x31 * normal_x + y31 * normal_y + s31 * (x12 * y23 - x23 * y12)
    poses = np.empty((len(bearing), 3))
    with np.errstate(divide='ignore', invalid='ignore'):
        scale = k31 / determinant
        x, y = scale * normal_x, scale * normal_y
        # Heading: direction of the sum of range * exp(i (azimuth - bearing)), with bearings
        # relative to the second. Far landmarks determine it better.
        xa -= x
        ya -= y
        xc -= x
        yc -= y
        real = xa * c12 - ya * s12 - x + xc * c23 + yc * s23
        imaginary = ya * c12 + xa * s12 - y + yc * c23 - xc * s23
        poses[:, 0], poses[:, 1] = x + x2, y + y2
        poses[:, 2] = wrap_rad(np.arctan2(imaginary, real) - b2)
    return poses


# Triples tried as starts: all of them for up to 12 landmarks.
_MAX_STARTS = 220
_MAX_STEPS = 20
# Least share of the information that remains in a direction when bearings are removed.
_LEAST_EIGENVALUE = 1e-9
_UNDETERMINED = Refusal('degenerate geometry', 'the bearings leave a direction undetermined')


@dataclass(frozen=True, eq=False)
class Fix:
    """
    A least-squares pose (3,) of the pan axis with the heading of the base, in map.

    Its covariance (3, 3) is of first order, with the errors of the map. Jacobian, residuals and
    weights are those of the bearings `used`, which is a mask (n,) of those given.
    """

    pose: FloatArray
    covariance: FloatArray
    jacobian: FloatArray
    residual: FloatArray
    weight: FloatArray
    used: BoolArray

    @property
    def chi_square(self) -> float:
        """Chi-square of the residuals, with three degrees of freedom less than bearings used."""
        return float(self.residual @ self.weight @ self.residual)

    def at(self, stamp_ns: int) -> PoseEstimate:
        """Return the pose as an estimate of that time."""
        return PoseEstimate(stamp_ns, self.pose, self.covariance)

    def covariance_without(self, rows: BoolArray) -> FloatArray:
        """Covariance (3, 3) of the pose without the bearings selected by `rows` (n,)."""
        weighted = (self.weight @ self.jacobian)[rows]
        lost = weighted.T @ np.linalg.solve(self.weight[np.ix_(rows, rows)], weighted)
        # In units of the covariance, rounding does not matter; a direction that is undetermined
        # without them gets a large variance.
        root = np.linalg.cholesky(self.covariance)
        value, vector = np.linalg.eigh(np.eye(3) - root.T @ lost @ root)
        back = root @ vector
        return np.asarray(back / np.maximum(value, _LEAST_EIGENVALUE) @ back.T)


class Bearings(NamedTuple):
    """Bearings of n landmarks, whose positions have the joint covariance (2 n, 2 n) `map_cov`."""

    position: FloatArray
    bearing: FloatArray
    variance: FloatArray
    map_cov: FloatArray

    def chosen(self, index: IndexArray) -> Bearings:
        """Return the bearings of some landmarks."""
        rows = np.stack([2 * index, 2 * index + 1], -1).reshape(-1)
        position, bearing, variance = (values[index] for values in self[:3])
        return Bearings(position, bearing, variance, self.map_cov[np.ix_(rows, rows)])

    def best_start(self, start: PoseEstimate | None) -> FloatArray | None:
        """Pose (3,) of those of triples and the prior with the least robust cost."""
        index = triples(len(self.bearing), _MAX_STARTS)
        poses = triangulate_three(self.position[index], self.bearing[index])
        if start is not None:
            poses = np.vstack([poses, start.pose])
        poses = poses[np.isfinite(poses).all(axis=-1)]
        if not len(poses):
            return None
        # Cauchy's cost: an outlier counts with the logarithm of its residual only.
        square = bearing_residuals(poses, self.position, self.bearing) ** 2 / self.variance
        return np.asarray(poses[np.argmin(np.sum(np.log1p(square / 9.0), axis=-1))])

    def solve(self, start: FloatArray) -> Fix | Refusal:
        """Gauss-Newton with weights updated in each iteration; steps of at most 1 m and 1 rad."""
        pose, jacobian = start.copy(), np.full((len(self.bearing), 3), -1.0)
        for _ in range(_MAX_STEPS):
            gradient = bearing_gradients(pose, self.position)
            residual = bearing_residuals(pose, self.position, self.bearing)
            jacobian[:, :2] = gradient
            own = np.diag(self.variance)
            weight = np.asarray(np.linalg.inv(own + map_share(gradient, self.map_cov)))
            normal = jacobian.T @ weight @ jacobian
            # Scaled to a unit diagonal, the rank of the normal matrix does not depend on units.
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
            # The next step would be at least a hundred times smaller.
            if np.abs(step).max() < 1e-8:
                pose[2] = wrap_rad(pose[2])
                used = np.ones(len(residual), dtype=np.bool_)
                return Fix(pose, covariance, jacobian, residual, weight, used)
        return Refusal('no convergence', f'last step {np.abs(step).max():.1e} m or rad')


def w_statistics(solved: Fix) -> FloatArray:
    """Normalized residuals (n,): the w-statistic of each bearing (Baarda, 1968)."""
    weighted = solved.weight @ solved.residual
    spread = solved.weight @ solved.jacobian
    variance = np.diag(solved.weight - spread @ solved.covariance @ spread.T)
    return np.asarray(np.abs(weighted) / np.sqrt(np.maximum(variance, 1e-300)))
