"""Motion by odometry between given times, with its covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.se2 import compose, compose_jacobians, rotation
from landmark_nav.localization.odometry.noise import (
    jitter_variances,
    left_variance,
    motion_variances,
    OdometryNoiseConfig,
)
from landmark_nav.localization.odometry.track import OdometryTrack, steps_ns
from landmark_nav.types import FloatArray, OdometrySample, PlaceChain

# Motion is compounded in arcs of about this duration.
_STEP_NS = 50_000_000
# Least variance, for two poses at one time: (0.1 mm)^2 and (0.1 mrad)^2.
_LEAST_VARIANCE = 1e-8


@dataclass(frozen=True, eq=False)
class Motions:
    """
    Motions between consecutive times.

    Parameters
    ----------
    increment : ndarray, shape (m, 3)
        Pose at each time in the frame of the one before.
    by_bias : ndarray, shape (m, 3, 4)
        Derivative by the scale of the way, the drift per metre, the scale of turns and the way
        lost in turns.
    covariance : ndarray, shape (m, 3, 3)
        Covariance of the random errors.
    """

    increment: FloatArray
    by_bias: FloatArray
    covariance: FloatArray


def motions_between(
    stamps_ns: npt.NDArray[np.int64],
    odometry: Sequence[OdometrySample],
    config: OdometryNoiseConfig,
) -> Motions:
    """
    Compound the odometry between times (m + 1,).

    Side slip is a state of the filter. Here it is white noise, with the same effect over ways
    that are much longer than its correlation length.
    """
    track = OdometryTrack(config)
    for sample in odometry:
        track.add(sample)
    parts = [
        _between(steps_ns(begin, end, _STEP_NS), track, config)
        for begin, end in pairwise(stamps_ns.tolist())
    ]
    increment, by_bias, covariance = (np.array(part) for part in zip(*parts, strict=True))
    return Motions(increment, by_bias, covariance)


def _between(
    times_ns: Sequence[int], track: OdometryTrack, config: OdometryNoiseConfig
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Increment (3,), its derivative by the biases (3, 4) and its covariance (3, 3)."""
    poses, steps, variances = [np.zeros(3)], [], []
    for begin, end in pairwise(times_ns):
        motion = track.motion(begin, end)
        variance = motion_variances(motion, config)
        variance[1] = left_variance(motion, config)
        steps.append(motion.increment)
        variances.append(variance)
        poses.append(compose(poses[-1], motion.increment))
    pose, step = np.array(poses), np.array(steps)
    # Derivative of the last pose by each step in its own frame: a turn also moves the later steps.
    lever = pose[-1, :2] - pose[1:, :2]
    effect = np.zeros((len(step), 3, 3))
    effect[:, :2, :2] = rotation(pose[:-1, 2])
    effect[:, 0, 2], effect[:, 1, 2] = -lever[:, 1], lever[:, 0]
    effect[:, 2, 2] = 1.0
    shifted = np.zeros((len(step), 3, 4))
    shifted[:, :2, 0] = step[:, :2]
    shifted[:, 2, 1] = step[:, 0]
    shifted[:, 2, 2] = step[:, 2]
    shifted[:, 0, 3] = -np.abs(step[:, 2])
    covariance = np.einsum('mij,mj,mkj->ik', effect, np.array(variances), effect)
    jitter = jitter_variances(track.motion(int(times_ns[0]), int(times_ns[-1])))
    covariance += np.diag(jitter + _LEAST_VARIANCE)
    return pose[-1], np.sum(effect @ shifted, axis=0), covariance


def chained(motions: Motions, config: OdometryNoiseConfig) -> PlaceChain:
    """
    Poses at all times in the frame of the first, with their joint covariance.

    Systematic errors of the wheels are common to all motions (Smith, Self and Cheeseman, 1990).
    """
    count = len(motions.increment) + 1
    poses = np.zeros((count, 3))
    # Loadings of each pose by the systematic errors and by the random errors of each motion.
    bias_sigma = np.array([*config.bias_sigmas, config.turn_loss_sigma_m_per_rad])
    loading = np.zeros((count, 3, len(bias_sigma) + 3 * len(motions.increment)))
    for k, (step, by_bias, covariance) in enumerate(
        zip(motions.increment, motions.by_bias, motions.covariance, strict=True)
    ):
        by_pose, by_step = compose_jacobians(poses[k], step)
        poses[k + 1] = compose(poses[k], step)
        own = len(bias_sigma) + 3 * k
        loading[k + 1] = by_pose @ loading[k]
        loading[k + 1, :, : len(bias_sigma)] += by_step @ by_bias * bias_sigma
        loading[k + 1, :, own : own + 3] += by_step @ np.linalg.cholesky(covariance)
    flat = loading.reshape(3 * count, -1)
    return PlaceChain(poses, flat @ flat.T)
