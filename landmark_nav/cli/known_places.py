"""What a bag says of where its sweeps were taken, if no paper does: poses given, or odometry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.localization.odometry.motions import chained, motions_between
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.message_filter import MessageFilter
from landmark_nav.types import OdometrySample, PlaceChain, Sweep

__all__ = ['known_places', 'scale_source']

# A robot that moves farther while it takes a sweep, by odometry, does not stand: m and rad.
_STANDS_M, _STANDS_RAD = 0.03, 0.02


def scale_source(bag: Bag) -> str:
    """
    Name what gives the scale of a map that is learned without a plan.

    Raises
    ------
    LandmarkNavError
        Nothing does.

    """
    for topic in ('sweep/pose', 'odom'):
        if bag.find(topic):
            return topic
    raise LandmarkNavError(
        f'{bag.path}: nothing gives the scale: record odom from sweep to sweep, publish '
        'sweep/pose, or measure walls and papers and give --room'
    )


def known_places(bag: Bag, sweeps: Sequence[Sweep], config: OdometryNoiseConfig) -> PlaceChain:
    """
    Poses of sweeps as `scale_source` gives them.

    Raises
    ------
    LandmarkNavError
        It does not say where each was taken, or the robot moved in one of them.

    """
    if scale_source(bag) == 'sweep/pose':
        return _given(bag, sweeps)
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
    return PlaceChain(poses, joint.reshape(3 * count, 3 * count))
