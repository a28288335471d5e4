"""
Odometry of robots that log commanded velocities only: their integral, with a delay.

A base follows its commands late. Odometry with the stamps of the commands is ahead of the images;
`command_delay_s` estimates by how much.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from landmark_nav.arrays import IntArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.types import Detections, FloatArray, OdometrySample

_DELAYS_S = np.arange(0.0, 0.601, 0.01)
# Greatest time between two compared detections of a landmark, s.
_PAIR_S = 1.0
# With fewer pairs, or turns that differ by less, the delay is not observable.
_MIN_PAIRS = 30
_LEAST_TURN_RAD = 0.05


def integrate_commands(
    stamps_ns: IntArray, commands: FloatArray, delay_s: float
) -> tuple[OdometrySample, ...]:
    """
    Integrate commanded velocities from the origin; stamps are the times at which they take effect.

    Parameters
    ----------
    stamps_ns : ndarray of int, shape (n,)
        Stamps of the commands, increasing.
    commands : ndarray, shape (n, 2)
        Forward [m/s] and turning [rad/s] velocity, each until the next.
    delay_s : float
        Time from a command to its effect.
    """
    seconds = 1e-9 * np.diff(stamps_ns)
    turn = commands[:-1, 1] * seconds
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    # A constant twist is an arc: its chord points along the middle heading.
    chord = commands[:-1, 0] * seconds * np.sinc(turn / (2.0 * np.pi))
    middle = heading[:-1] + 0.5 * turn
    steps = chord[:, None] * np.stack([np.cos(middle), np.sin(middle)], -1)
    poses = np.column_stack([np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), heading])
    poses[:, 2] = wrap_rad(poses[:, 2])
    late = stamps_ns + round(delay_s * 1e9)
    return tuple(
        OdometrySample(int(stamp), pose, float(linear), float(angular))
        for stamp, pose, (linear, angular) in zip(late, poses, commands, strict=True)
    )


def command_delay_s(
    stamps_ns: IntArray, commands: FloatArray, detections: Sequence[Detections]
) -> float:
    """
    Time from a command to its effect, estimated from bearings.

    When the robot turns, bearings change by the opposite angle. The delay is the one at which the
    commanded turn best explains the change of bearings within a second. Parallax is small against
    that and has either sign.

    Raises `LandmarkNavError`: too few landmarks were seen twice within a second, or the robot did
    not turn meanwhile.

    Parameters
    ----------
    stamps_ns : ndarray of int, shape (n,)
        Stamps of the commands, increasing.
    commands : ndarray, shape (n, 2)
        Forward [m/s] and turning [rad/s] velocity, each until the next.
    detections : sequence of Detections
        Detections of a camera that is fixed on the robot.
    """
    ids = np.concatenate([np.empty(0, np.int64), *(seen.ids for seen in detections)])
    stamps = np.repeat([seen.stamp_ns for seen in detections], [len(seen) for seen in detections])
    bearings = np.concatenate([np.empty(0), *(seen.bearing_rad for seen in detections)])
    order = np.lexsort((stamps, ids))
    ids, bearings = ids[order], bearings[order]
    seconds = 1e-9 * (stamps[order] - stamps_ns[0])
    pair = np.flatnonzero((np.diff(ids) == 0) & (np.diff(seconds) < _PAIR_S))
    times = 1e-9 * (stamps_ns - stamps_ns[0])
    heading = np.concatenate([[0.0], np.cumsum(commands[:-1, 1] * np.diff(times))])
    observed = -wrap_rad(np.diff(bearings)[pair])
    reckoned = np.interp(seconds - _DELAYS_S[:, None], times, heading)
    commanded = reckoned[:, pair + 1] - reckoned[:, pair]
    if len(pair) < _MIN_PAIRS or np.ptp(commanded) < _LEAST_TURN_RAD:
        raise LandmarkNavError(
            f'the delay of the commands cannot be found: {len(pair)} bearings were seen twice '
            'within a second, or the robot never turned then: give it'
        )
    gain = (commanded @ observed) / np.maximum(np.sum(commanded**2, axis=1), 1e-12)
    # The L1 norm is robust against landmarks mistaken for others.
    missed = np.abs(observed - gain[:, None] * commanded)
    return float(_DELAYS_S[int(np.argmin(np.mean(missed, axis=1)))])
