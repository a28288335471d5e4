"""Where sweeps were taken, if no paper shows it: poses given, or odometry between them."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.se2 import compose, compose_jacobians, rotation
from landmark_nav.localization.odometry.motions import chained, Motions, motions_between
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.types import FloatArray, OdometrySample, PlaceChain, PoseEstimate

# A robot that moves farther while it takes a sweep, by odometry, does not stand: m and rad.
_STANDS_M, _STANDS_RAD = 0.03, 0.02
# Samples before and after the times that are asked for.
_MARGIN = 20


def known_places(
    given: Sequence[PoseEstimate | None],
    spans_ns: Sequence[tuple[int, int]],
    samples: Sequence[OdometrySample],
    config: OdometryNoiseConfig,
) -> list[PlaceChain]:
    """
    Poses of sweeps by each source that has them: those of the first give the frame.

    Raises `LandmarkNavError`: one does not say where each was taken, or the robot moved in one of
    them.

    Parameters
    ----------
    given : sequence of PoseEstimate or None
        What was published for each sweep.
    spans_ns, samples, config
        As of `places_by_odometry`; without samples odometry is no source.
    """
    known = [_given_places(given)] if any(pose is not None for pose in given) else []
    if samples:
        driven = places_by_odometry(spans_ns, samples, config)
        known.append(_seen_from(driven, known[0].poses[0]) if known else driven)
    return known


def _seen_from(places: PlaceChain, first: FloatArray) -> PlaceChain:
    """Poses in the frame of the first sweep, in the frame in which that is `first` (3,)."""
    count = len(places.poses)
    turn = np.kron(np.eye(count), block_diag(rotation(first[2]), 1.0))
    poses = np.array([compose(first, pose) for pose in places.poses])
    return PlaceChain(poses, turn @ places.covariance @ turn.T, places.source)


def places_by_odometry(
    spans_ns: Sequence[tuple[int, int]],
    samples: Sequence[OdometrySample],
    config: OdometryNoiseConfig,
) -> PlaceChain:
    """
    Poses of the base at the beginnings of sweeps, by odometry.

    Raises `LandmarkNavError`: odometry does not cover a sweep, or the robot moved in one.

    Parameters
    ----------
    spans_ns : sequence of tuple of int
        First and last stamp of each sweep.
    samples : sequence of OdometrySample
        By time, from the first sweep to the last.
    """
    for number, (begin, end) in enumerate(spans_ns, 1):
        if not samples or samples[0].stamp_ns > end or samples[-1].stamp_ns < begin:
            raise LandmarkNavError(
                f'odom does not cover sweep {number} (of {begin * 1e-9:.1f} s): it must come from '
                'the first sweep to the last'
            )
        x, y, turn = _motions([begin, end], samples, config).increment[0]
        if np.hypot(x, y) > _STANDS_M or abs(turn) > _STANDS_RAD:
            raise LandmarkNavError(
                f'the robot moved {100 * np.hypot(x, y):.0f} cm and '
                f'{np.degrees(turn):.1f} deg by odom in sweep {number}: let it stand, sweep again'
            )
    return chained(_motions([begin for begin, _ in spans_ns], samples, config), config)


def _given_places(given: Sequence[PoseEstimate | None]) -> PlaceChain:
    """
    Poses of sweeps that were published, in the frame of the first: its error moves the whole map.

    Raises `LandmarkNavError`: a sweep has none.
    """
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
    """Pose at the last sample of odometry (one or more), from one at an earlier time."""
    end_ns = samples[-1].stamp_ns
    chain = chained(_motions([place.stamp_ns, end_ns], samples, config), config)
    by_pose, by_way = compose_jacobians(place.pose, chain.poses[1])
    covariance = by_pose @ place.covariance @ by_pose.T
    covariance += by_way @ chain.covariance[3:, 3:] @ by_way.T
    return PoseEstimate(end_ns, compose(place.pose, chain.poses[1]), covariance)


def _motions(
    stamps_ns: Sequence[int], samples: Sequence[OdometrySample], config: OdometryNoiseConfig
) -> Motions:
    """Motions between times, by the samples around them: hours of others cost time."""
    known = [sample.stamp_ns for sample in samples]
    first = max(bisect_left(known, stamps_ns[0]) - _MARGIN, 0)
    last = bisect_right(known, stamps_ns[-1]) + _MARGIN
    return motions_between(np.array(stamps_ns), samples[first:last], config)
