"""What a bag says of where its sweeps were taken, if no paper does: poses given, or odometry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.se2 import compose, rotation
from landmark_nav.learning.sheets import SheetsConfig
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.smoother.motion import chained, motions_between
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.message_filter import MessageFilter
from landmark_nav.types import FloatArray, OdometrySample, PlaceChain, Sweep

__all__ = ['check_scale', 'known_places']

# A robot that moves farther while it takes a sweep, by odometry, does not stand: m and rad.
_STANDS_M, _STANDS_RAD = 0.03, 0.02


def check_scale(bag: Bag, sheets: SheetsConfig) -> None:
    """
    Check that something gives the scale of a map that is learned without a plan.

    Raises
    ------
    LandmarkNavError
        Nothing does.

    """
    posed = bag.find('sweep/pose') or bag.find('odom')
    if not (posed or sheets.has_papers or sheets.has_markers):
        raise LandmarkNavError(
            f'{bag.path}: nothing gives the scale: record odom, publish sweep/pose, hang sheets '
            '(--paper-size, --marker-size), or measure walls and papers (--room)'
        )


def known_places(
    bag: Bag, sweeps: Sequence[Sweep], config: OdometryNoiseConfig
) -> list[PlaceChain]:
    """
    Poses of sweeps by each source that has them: those of the first give the frame.

    Raises
    ------
    LandmarkNavError
        One does not say where each was taken, or the robot moved in one of them.

    """
    known = [_given(bag, sweeps)] if bag.find('sweep/pose') else []
    if bag.find('odom'):
        driven = _driven(bag, sweeps, config)
        known.append(_seen_from(driven, known[0].poses[0]) if known else driven)
    return known


def _seen_from(places: PlaceChain, first: FloatArray) -> PlaceChain:
    """Poses in the frame of the first sweep, in the frame in which that is `first` (3,)."""
    count = len(places.poses)
    turn = np.kron(np.eye(count), block_diag(rotation(first[2]), 1.0))
    poses = np.array([compose(first, pose) for pose in places.poses])
    return PlaceChain(poses, turn @ places.covariance @ turn.T, places.source)


def _driven(bag: Bag, sweeps: Sequence[Sweep], config: OdometryNoiseConfig) -> PlaceChain:
    """Poses by odometry; the robot stands while it takes a sweep."""
    topic = bag.require('odom')
    messages = MessageFilter(bag, topic)
    read = (
        messages.take(lambda entry: decode.odometry(entry.message), entry)
        for entry in bag.messages([topic])
    )
    samples = sorted((s for s in read if s is not None), key=lambda s: s.stamp_ns)
    messages.report()
    for number, sweep in enumerate(sweeps, 1):
        _check_covered(bag, number, sweep, samples)
        ends = np.array([sweep.frames[0].stamp_ns, sweep.frames[-1].stamp_ns])
        x, y, turn = motions_between(ends, samples, config).increment[0]
        if np.hypot(x, y) > _STANDS_M or abs(turn) > _STANDS_RAD:
            raise LandmarkNavError(
                f'{bag.path}: the robot moved {100 * np.hypot(x, y):.0f} cm and '
                f'{np.degrees(turn):.1f} deg by odom in sweep {number}: let it stand, sweep again'
            )
    stamps = np.array([sweep.stamp_ns for sweep in sweeps])
    return chained(motions_between(stamps, samples, config), config)


def _check_covered(bag: Bag, number: int, sweep: Sweep, samples: Sequence[OdometrySample]) -> None:
    begin, end = sweep.frames[0].stamp_ns, sweep.frames[-1].stamp_ns
    if not samples or samples[0].stamp_ns > end or samples[-1].stamp_ns < begin:
        raise LandmarkNavError(
            f'{bag.path}: odom does not cover sweep {number} (of {begin * 1e-9:.1f} s): record it '
            'from the first sweep to the last'
        )


def _given(bag: Bag, sweeps: Sequence[Sweep]) -> PlaceChain:
    """Poses that were published, in the frame of the first: its own error moves the whole map."""
    given = [sweep.pose_map_base for sweep in sweeps]
    if any(pose is None for pose in given):
        missing = 1 + next(k for k, pose in enumerate(given) if pose is None)
        raise LandmarkNavError(
            f'{bag.path}: sweep {missing} has no sweep/pose, others have: publish it for each'
        )
    known = [pose for pose in given if pose is not None]
    poses = np.array([pose.pose for pose in known])
    count = len(known)
    joint = np.zeros((count, 3, count, 3))
    first = known[0].covariance
    moved = np.tile(np.eye(3), (count, 1, 1))
    way = poses[:, :2] - poses[0, :2]
    moved[:, 0, 2], moved[:, 1, 2] = -way[:, 1], way[:, 0]
    for k in range(1, count):
        joint[k, :, k] = known[k].covariance
    joint[1:, :, 1:] += np.einsum('aij,jk,blk->aibl', moved[1:], first, moved[1:])
    return PlaceChain(poses, joint.reshape(3 * count, 3 * count), 'sweep/pose')
