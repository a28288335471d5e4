"""
Planar poses as arrays (..., 3) of x [m], y [m], theta [rad].

``pose_a_b`` is the pose of frame b in frame a; ``compose(pose_a_b, pose_b_c)`` is ``pose_a_c``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import Float32Array, FloatArray
from landmark_nav.geometry.angles import wrap_one_rad, wrap_rad


def rotation(theta_rad: npt.ArrayLike) -> FloatArray:
    """Rotation matrices (..., 2, 2) of angles (...)."""
    theta = np.asarray(theta_rad, dtype=np.float64)
    turned = np.empty((*theta.shape, 2, 2))
    turned[..., 0, 0] = turned[..., 1, 1] = np.cos(theta)
    turned[..., 1, 0] = np.sin(theta)
    turned[..., 0, 1] = -turned[..., 1, 0]
    return turned


def cross(first: FloatArray | Float32Array, second: FloatArray | Float32Array) -> FloatArray:
    """Cross products (...) in plan of vectors (..., 2) or (..., 3)."""
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def crossing(
    start: FloatArray, along: FloatArray, other: FloatArray, other_along: FloatArray
) -> FloatArray:
    """Intersection (2,) of two lines in plan, each by a point (2,) and a direction (2,)."""
    share = cross(other - start, other_along) / cross(along, other_along)
    return np.asarray(start + share * along)


def compose(pose_a_b: npt.ArrayLike, pose_b_c: npt.ArrayLike) -> FloatArray:
    """Pose of c in a, (..., 3), from b in a and c in b; the heading is wrapped."""
    first = np.asarray(pose_a_b, dtype=np.float64)
    second = np.asarray(pose_b_c, dtype=np.float64)
    if first.ndim == second.ndim == 1:
        # Fast path: most calls are for single poses.
        x, y, theta = first.tolist()
        forward, left, turn = second.tolist()
        c, s = math.cos(theta), math.sin(theta)
        moved = (x + c * forward - s * left, y + s * forward + c * left)
        return np.array([*moved, wrap_one_rad(theta + turn)])
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    return _pose(
        first[..., 0] + cos * second[..., 0] - sin * second[..., 1],
        first[..., 1] + sin * second[..., 0] + cos * second[..., 1],
        first[..., 2] + second[..., 2],
    )


def inverse(pose_a_b: npt.ArrayLike) -> FloatArray:
    """Pose of a in b, (..., 3)."""
    pose = np.asarray(pose_a_b, dtype=np.float64)
    if pose.ndim == 1:
        x, y, theta = pose.tolist()
        c, s = math.cos(theta), math.sin(theta)
        return np.array([-c * x - s * y, s * x - c * y, wrap_one_rad(-theta)])
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    return _pose(
        -cos * pose[..., 0] - sin * pose[..., 1],
        sin * pose[..., 0] - cos * pose[..., 1],
        -pose[..., 2],
    )


def _pose(x: FloatArray, y: FloatArray, theta: FloatArray) -> FloatArray:
    return np.stack([x, y, wrap_rad(theta)], -1)


def relative(pose_a_b: npt.ArrayLike, pose_a_c: npt.ArrayLike) -> FloatArray:
    """Pose of c in b, (..., 3)."""
    return compose(inverse(pose_a_b), pose_a_c)


def compose_jacobians(
    pose_a_b: npt.ArrayLike, pose_b_c: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """
    Derivatives of `compose` by its first and second argument, each (3, 3).

    Smith, Self and Cheeseman, Estimating Uncertain Spatial Relationships in Robotics, 1990.
    """
    first = np.asarray(pose_a_b, dtype=np.float64)
    second = np.asarray(pose_b_c, dtype=np.float64)
    theta, forward, left = float(first[2]), float(second[0]), float(second[1])
    cos, sin = math.cos(theta), math.sin(theta)
    by_x, by_y = -sin * forward - cos * left, cos * forward - sin * left
    by_first = np.array([[1.0, 0.0, by_x], [0.0, 1.0, by_y], [0.0, 0.0, 1.0]])
    by_second = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return by_first, by_second


def arc(way_m: float, turn_rad: float) -> FloatArray:
    """Relative pose (3,) after a motion along a circular arc or a straight line."""
    chord = way_m * sinc(turn_rad / math.tau)
    return np.array([chord * math.cos(turn_rad / 2.0), chord * math.sin(turn_rad / 2.0), turn_rad])


def sinc(x: float) -> float:
    """``np.sinc``, with pi in it, of one number."""
    return math.sin(math.pi * x) / (math.pi * x) if x else 1.0


def squared_distance(pose: FloatArray, other: FloatArray, covariance: FloatArray) -> float:
    """Squared Mahalanobis distance of two poses (3,), by the covariance of their difference."""
    offset = pose - other
    offset[2] = wrap_rad(offset[2])
    return float(offset @ np.linalg.solve(covariance, offset))


def transform_points(pose_a_b: npt.ArrayLike, points_b: npt.ArrayLike) -> FloatArray:
    """Transform points (..., 2) from b to a."""
    pose = np.asarray(pose_a_b, dtype=np.float64)
    points = np.asarray(points_b, dtype=np.float64)
    return np.asarray(points @ rotation(pose[2]).T + pose[:2])


def bearings(pose_a_b: FloatArray, points_a: FloatArray) -> FloatArray:
    """Bearings (...) of points (..., 2) in a, counter-clockwise from the heading of b."""
    delta = points_a - pose_a_b[:2]
    return wrap_rad(np.arctan2(delta[..., 1], delta[..., 0]) - pose_a_b[2])


def rotation_rpy(rpy_rad: npt.ArrayLike) -> FloatArray:
    """Rotation (3, 3) of fixed-axis roll, pitch, yaw: Rz(yaw) Ry(pitch) Rx(roll), as in URDF."""
    roll, pitch, yaw = np.asarray(rpy_rad, dtype=np.float64)
    return np.asarray(rot_z(yaw) @ rot_y(pitch) @ rot_x(roll))


def rot_x(angle: Any) -> FloatArray:
    """Rotations (..., 3, 3) by angles (...) about x, radians."""
    return _rotation_about(0, angle)


def rot_y(angle: Any) -> FloatArray:
    """Rotations (..., 3, 3) by angles (...) about y, radians."""
    return _rotation_about(1, angle)


def rot_z(angle: Any) -> FloatArray:
    """Rotations (..., 3, 3) by angles (...) about z, radians."""
    return _rotation_about(2, angle)


def _rotation_about(axis: int, angle: Any) -> FloatArray:
    first, second = (axis + 1) % 3, (axis + 2) % 3
    if isinstance(angle, float):
        # Fast path: most calls are for single angles.
        entries = [0.0] * 9
        entries[4 * axis] = 1.0
        entries[4 * first] = entries[4 * second] = math.cos(angle)
        entries[3 * second + first] = sine = math.sin(angle)
        entries[3 * first + second] = -sine
        return np.array(entries).reshape(3, 3)
    cos, sin = np.cos(angle), np.sin(angle)
    out = np.zeros((*np.shape(angle), 3, 3))
    out[..., axis, axis] = 1.0
    out[..., first, first] = out[..., second, second] = cos
    out[..., first, second] = -sin
    out[..., second, first] = sin
    return out
