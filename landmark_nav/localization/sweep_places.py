"""
Poses of sweeps without papers: those published, or odometry between the sweeps.

Motion by odometry between given times comes with its covariance.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.se2 import compose, compose_jacobians, rotation
from landmark_nav.localization.odometry.noise import (
    jitter_variances,
    left_variance,
    motion_variances,
    OdometryNoiseConfig,
)
from landmark_nav.localization.odometry.track import OdometryTrack, steps_ns
from landmark_nav.types import FloatArray, OdometrySample, PlaceChain, PoseEstimate

# Motion is compounded in arcs of about this duration.
_STEP_NS = 50_000_000
# Least variance, for two poses at one time: (0.1 mm)^2 and (0.1 mrad)^2.
_LEAST_VARIANCE = 1e-8


def _between(
    times_ns: Sequence[int], track: OdometryTrack, config: OdometryNoiseConfig
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Increment (3,), its derivative by the biases (3, 4) and the covariance (3, 3) of the rest.

    Biases are scale of the way, drift per metre, scale of turns, and way lost in turns.
    """
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


def _chain(
    stamps_ns: Sequence[int], samples: Sequence[OdometrySample], config: OdometryNoiseConfig
) -> PlaceChain:
    """
    Poses at some times in the frame of the first, with their joint covariance.

    Systematic errors of the wheels are common to all motions (Smith, Self and Cheeseman, 1990).
    Side slip is white noise here, with the same effect over ways that are much longer than its
    correlation length.
    """
    known = [sample.stamp_ns for sample in samples]
    # There may be hours of other samples.
    first = max(bisect_left(known, stamps_ns[0]) - _MARGIN, 0)
    track = OdometryTrack(config)
    for sample in samples[first : bisect_right(known, stamps_ns[-1]) + _MARGIN]:
        track.add(sample)
    poses = np.zeros((len(stamps_ns), 3))
    # Loadings of each pose by the systematic errors and by the random errors of each motion.
    bias_sigma = np.array([*config.bias_sigmas, config.turn_loss_sigma_m_per_rad])
    biases = len(bias_sigma)
    loading = np.zeros((len(poses), 3, biases + 3 * (len(poses) - 1)))
    for k, (begin, end) in enumerate(pairwise(stamps_ns)):
        step, by_bias, covariance = _between(steps_ns(begin, end, _STEP_NS), track, config)
        by_pose, by_step = compose_jacobians(poses[k], step)
        poses[k + 1] = compose(poses[k], step)
        own = biases + 3 * k
        loading[k + 1] = by_pose @ loading[k]
        loading[k + 1, :, :biases] += by_step @ by_bias * bias_sigma
        loading[k + 1, :, own : own + 3] += by_step @ np.linalg.cholesky(covariance)
    flat = loading.reshape(3 * len(poses), -1)
    return PlaceChain(poses, flat @ flat.T)


# Greatest motion by odometry during a sweep, m and rad: the robot must stand.
_STANDS_M, _STANDS_RAD = 0.03, 0.02
# Samples used before and after the requested times.
_MARGIN = 20
# Sigma of a slip of the wheels between two sweeps, m.
_SLIP_M = 0.1


def known_places(
    given: Sequence[PoseEstimate | None],
    spans_ns: Sequence[tuple[int, int]],
    samples: Sequence[OdometrySample],
    config: OdometryNoiseConfig,
) -> list[PlaceChain]:
    """
    Poses of sweeps by each source; the first source defines the frame.

    Raises `LandmarkNavError`: a source lacks the pose of a sweep, or the robot moved during one.

    Parameters
    ----------
    given : sequence of PoseEstimate or None
        Pose published for each sweep.
    spans_ns, samples, config
        As in `places_by_odometry`; without samples odometry is no source.
    """
    known = [_given_places(given)] if any(pose is not None for pose in given) else []
    if samples:
        driven = places_by_odometry(spans_ns, samples, config)
        known.append(_seen_from(driven, known[0].poses[0]) if known else driven)
    return known


def _seen_from(places: PlaceChain, first: FloatArray) -> PlaceChain:
    """Transform poses from the frame of the first sweep to the one where it is `first` (3,)."""
    count = len(places.poses)
    turn = np.kron(np.eye(count), block_diag(rotation(first[2]), 1.0))
    poses = np.array([compose(first, pose) for pose in places.poses])
    return replace(places, poses=poses, covariance=turn @ places.covariance @ turn.T)


def places_by_odometry(
    spans_ns: Sequence[tuple[int, int]],
    samples: Sequence[OdometrySample],
    config: OdometryNoiseConfig,
) -> PlaceChain:
    """
    Poses of the base at each sweep, by odometry.

    The middle of a sweep counts: samples that are lost as the robot stops do not matter there.

    Raises `LandmarkNavError`: odometry does not cover a sweep, or the robot moved during one.

    Parameters
    ----------
    spans_ns : sequence of tuple of int
        First and last stamp of each sweep.
    samples : sequence of OdometrySample
        Odometry in the order of time, from the first sweep to the last.
    """
    for number, (begin, end) in enumerate(spans_ns, 1):
        if not samples or samples[0].stamp_ns > end or samples[-1].stamp_ns < begin:
            raise LandmarkNavError(
                f'odom does not cover sweep {number} (of {begin * 1e-9:.1f} s): it must come from '
                'the first sweep to the last'
            )
        x, y, turn = _chain([begin, end], samples, config).poses[1]
        if np.hypot(x, y) > _STANDS_M or abs(turn) > _STANDS_RAD:
            raise LandmarkNavError(
                f'the robot moved {100 * np.hypot(x, y):.0f} cm and '
                f'{np.degrees(turn):.1f} deg by odom in sweep {number}: let it stand, sweep again'
            )
    middles = [(begin + end) // 2 for begin, end in spans_ns]
    return replace(_chain(middles, samples, config), slip_m=_SLIP_M)


def _given_places(given: Sequence[PoseEstimate | None]) -> PlaceChain:
    """Published poses of sweeps; the error of the first moves the whole map."""
    known = [pose for pose in given if pose is not None]
    if len(known) < len(given):
        missing = 1 + next(k for k, pose in enumerate(given) if pose is None)
        raise LandmarkNavError(
            f'sweep {missing} has no sweep/pose, others have: publish it for each'
        )
    poses = np.array([pose.pose for pose in known])
    count = len(known)
    joint = np.zeros((count, 3, count, 3))
    moved = np.tile(np.eye(3), (count, 1, 1))
    way = poses[:, :2] - poses[0, :2]
    moved[:, 0, 2], moved[:, 1, 2] = -way[:, 1], way[:, 0]
    for k in range(1, count):
        joint[k, :, k] = known[k].covariance
    joint[1:, :, 1:] += np.einsum('aij,jk,blk->aibl', moved[1:], known[0].covariance, moved[1:])
    return PlaceChain(poses, joint.reshape(3 * count, 3 * count), 'sweep/pose')


def carried_on(
    place: PoseEstimate, samples: Sequence[OdometrySample], config: OdometryNoiseConfig
) -> PoseEstimate:
    """Carry a pose on to the last of one or more samples of odometry."""
    end_ns = samples[-1].stamp_ns
    chain = _chain([place.stamp_ns, end_ns], samples, config)
    by_pose, by_way = compose_jacobians(place.pose, chain.poses[1])
    covariance = by_pose @ place.covariance @ by_pose.T
    covariance += by_way @ chain.covariance[3:, 3:] @ by_way.T
    return PoseEstimate(end_ns, compose(place.pose, chain.poses[1]), covariance)
