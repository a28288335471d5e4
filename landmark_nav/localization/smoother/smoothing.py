"""
The best line that all of a recording allows: every bearing corrects what was before it, too.

Dellaert and Kaess, Square Root SAM, International Journal of Robotics Research 25(12), 2006: one
sparse least-squares problem over all poses. Landmarks are refined with the map as their prior;
misidentified ones lose their weight (Cauchy's function), by iterated reweighting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import splu, SuperLU

from landmark_nav.arrays import IntArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.fusion import FusionConfig
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.smoother.motion import motions_between
from landmark_nav.localization.smoother.problem import Bearings, Problem
from landmark_nav.types import (
    Detections,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
)

__all__ = ['Smoothed', 'smooth']


# Columns of the inverse that are computed at a time.
_COLUMNS = 256


# Sigmas of a motion of which nothing is known, metres and radians.
_ANYWHERE = np.array([3.0, 3.0, 2.0])
# Residual, in sigmas, at which a bearing has half its weight.
_ROBUST_SIGMAS = 3.0
_MAX_ITERATIONS = 100
# Largest step, metres and radians, that ends it.
_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class Smoothed:
    """
    Smoothed poses.

    Parameters
    ----------
    stamps_ns : ndarray of int, shape (n,)
        Of the detections.
    poses : ndarray, shape (n, 3)
        ``base_link`` in map.
    covariances : ndarray, shape (n, 3, 3)
        Of x, y, heading, given all measurements.
    landmarks : ndarray, shape (l, 2)
        Where they turned out to be.
    boresight_rad : float
        Constant offset of all bearings.
    lens : float
        By how much the principal point is off, over the focal length.
    iterations : int
        Steps it took.

    """

    stamps_ns: IntArray
    poses: FloatArray
    covariances: FloatArray
    landmarks: FloatArray
    boresight_rad: float
    lens: float
    iterations: int


def smooth(
    start: PoseEstimate,
    odometry: Sequence[OdometrySample],
    sightings: Sequence[Detections],
    initial: FloatArray,
    landmark_map: LandmarkMap,
    mount: PanTiltMount,
    fusion: FusionConfig | None = None,
    noise: OdometryNoiseConfig | None = None,
    unknown_motion: npt.NDArray[np.bool_] | None = None,
    tolerance: float = _TOLERANCE,
) -> Smoothed:
    """
    Gauss-Newton over the poses of all detections, with the noise models of the filter.

    Parameters
    ----------
    start : PoseEstimate
        Prior of the first pose, not after the first detection.
    odometry : sequence of OdometrySample
        By time.
    detections : sequence of Detections
        By time; those without a landmark of the map become poses, too.
    initial : ndarray, shape (n, 3)
        Where to begin: the filter's poses at the detections.
    landmark_map : LandmarkMap
        Landmarks and their joint covariance.
    mount : PanTiltMount
        Where the pan axis is.
    unknown_motion : ndarray of bool, shape (n,), optional
        Before which detections nothing is known of how the robot moved.
    tolerance : float
        Largest step, metres and radians, that ends it.

    Raises
    ------
    LandmarkNavError
        No detection, times out of order, or no convergence.

    """
    stamps = np.array([start.stamp_ns, *(seen.stamp_ns for seen in sightings)], dtype=np.int64)
    if len(stamps) < 2 or np.any(np.diff(stamps) < 0):
        raise LandmarkNavError('smoother: needs detections in the order of time after the start')
    fusion, noise = fusion or FusionConfig(), noise or OdometryNoiseConfig()
    wheels = *noise.bias_sigmas, noise.turn_loss_sigma_m_per_rad
    motions = motions_between(stamps, odometry, noise)
    if unknown_motion is not None:
        motions.covariance[unknown_motion] += np.diag(np.square(_ANYWHERE))
    problem = Problem(
        start,
        motions,
        Bearings.of(sightings, landmark_map),
        landmark_map,
        np.asarray(mount.axis_xyz[:2], dtype=np.float64),
        np.array([*wheels, fusion.boresight_sigma_rad, fusion.principal_point_sigma]),
        mount.pan_sigma_rad,
        fusion.correlated_noise_fraction,
        fusion.repeat_length_m,
        _ROBUST_SIGMAS,
    )
    unknowns = problem.at(np.vstack([start.pose, initial]))
    iteration, moved = 0, np.inf
    while moved > tolerance:
        if iteration == _MAX_ITERATIONS:
            raise LandmarkNavError(
                f'smoother: still moves by {moved:.1e} after {iteration} steps: '
                'look at the odometry and the start'
            )
        iteration += 1
        jacobian, residual = problem.linearized(unknowns)
        factor = _factor(jacobian)
        step = factor.solve(-(jacobian.T @ residual))
        unknowns, moved = problem.advanced(unknowns, step)
    return Smoothed(
        stamps[1:],
        problem.poses(unknowns)[1:],
        _pose_covariances(factor, problem.pose_columns)[1:],
        problem.landmarks(unknowns),
        *problem.camera(unknowns),
        iteration,
    )


def _factor(jacobian: csr_matrix) -> SuperLU:
    """Factorize the normal matrix: symmetric and positive, so no pivot is worth its fill."""
    return splu(
        csc_matrix(jacobian.T @ jacobian),
        permc_spec='MMD_AT_PLUS_A',
        diag_pivot_thresh=0.0,
        options={'SymmetricMode': True},
    )


def _pose_covariances(factor: SuperLU, columns: npt.NDArray[np.intp]) -> FloatArray:
    """Blocks (n, 3, 3) of the inverse at `columns` (n, 3), some at a time: it is not sparse."""
    size = factor.shape[0]
    blocks = []
    for group in np.array_split(columns, max(1, columns.size // _COLUMNS)):
        unit = np.zeros((size, group.size))
        unit[group.ravel(), np.arange(group.size)] = 1.0
        solved = factor.solve(unit).reshape(size, -1, 3)
        blocks.append(np.stack([solved[rows, k] for k, rows in enumerate(group)]))
    return np.concatenate(blocks)
