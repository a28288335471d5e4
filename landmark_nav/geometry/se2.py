"""
Planar poses as arrays (..., 3) of x [m], y [m], theta [rad].

``pose_a_b`` is the pose of frame b in frame a; ``compose(pose_a_b, pose_b_c)`` is ``pose_a_c``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad

__all__ = ['compose', 'compose_jacobians', 'inverse', 'relative', 'rotation', 'transform_points']

FloatArray = npt.NDArray[np.float64]


def rotation(theta_rad: npt.ArrayLike) -> FloatArray:
    """Rotation matrices (..., 2, 2) of angles (...)."""
    theta = np.asarray(theta_rad, dtype=np.float64)
    cos, sin = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)


def compose(pose_a_b: npt.ArrayLike, pose_b_c: npt.ArrayLike) -> FloatArray:
    """Pose of c in a, (..., 3), from b in a and c in b; the heading is wrapped."""
    first, second = np.broadcast_arrays(
        np.asarray(pose_a_b, dtype=np.float64), np.asarray(pose_b_c, dtype=np.float64)
    )
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    return np.stack(
        [
            first[..., 0] + cos * second[..., 0] - sin * second[..., 1],
            first[..., 1] + sin * second[..., 0] + cos * second[..., 1],
            wrap_rad(first[..., 2] + second[..., 2]),
        ],
        -1,
    )


def inverse(pose_a_b: npt.ArrayLike) -> FloatArray:
    """Pose of a in b, (..., 3)."""
    pose = np.asarray(pose_a_b, dtype=np.float64)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    return np.stack(
        [
            -cos * pose[..., 0] - sin * pose[..., 1],
            sin * pose[..., 0] - cos * pose[..., 1],
            wrap_rad(-pose[..., 2]),
        ],
        -1,
    )


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
    cos, sin = np.cos(first[2]), np.sin(first[2])
    by_first = np.eye(3)
    by_first[0, 2] = -sin * second[0] - cos * second[1]
    by_first[1, 2] = cos * second[0] - sin * second[1]
    by_second = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return by_first, by_second


def transform_points(pose_a_b: npt.ArrayLike, points_b: npt.ArrayLike) -> FloatArray:
    """Points (..., 2) given in b, expressed in a."""
    pose = np.asarray(pose_a_b, dtype=np.float64)
    points = np.asarray(points_b, dtype=np.float64)
    return np.asarray(points @ rotation(pose[2]).T + pose[:2])
