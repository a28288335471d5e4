"""The path of an odometry: whether it jumps, and whether it leads where the robot heads."""

from __future__ import annotations

import numpy as np

from landmark_nav.diagnosis.findings import Finding
from landmark_nav.diagnosis.streams import Stream
from landmark_nav.diagnosis.units import steps_of

__all__ = ['check_jumps', 'check_path']

# A step is a jump if it is so many times the usual ones, and metres or radians.
_JUMP, _JUMP_M, _JUMP_RAD = 10.0, 0.3, 0.5
# More of them are no jumps but a source that is noisy, or two.
_MOST_JUMPS = 5
# How well directions of steps agree with the heading, of 1: that of a path in its own axes at
# least, and that of one in other axes at most.
_AGREES, _CONTRADICTS = 0.9, 0.7
_LEAST_PATH_M, _LEAST_STEPS = 0.5, 8


def check_jumps(stream: Stream) -> Finding | None:
    """Steps of an odometry (x, y, yaw, ...) that no robot makes; None where there is none."""
    if len(stream) < _LEAST_STEPS:
        return None
    moved = np.hypot(*np.diff(stream.values[:, :2], axis=0).T)
    turned = np.abs(np.angle(np.exp(1j * np.diff(stream.values[:, 2]))))
    # As far as it may go in the time of a step, which a gap makes longer.
    times = np.maximum(np.diff(stream.seconds), float(np.median(np.diff(stream.seconds))))
    jumps = np.zeros(len(moved), dtype=np.bool_)
    for size, least in ((moved, _JUMP_M), (turned, _JUMP_RAD)):
        speed = size / np.maximum(times, 1e-6)
        usual = float(np.quantile(speed, 0.95))
        jumps |= (size > least) & (speed > _JUMP * usual)
    if not 0 < jumps.sum() <= _MOST_JUMPS:
        return None
    first = int(np.argmax(jumps))
    return Finding(
        'odom jumps',
        'warning',
        f'jumps by {moved[first]:.2f} m and {np.degrees(turned[first]):.0f} deg at '
        f'{stream.seconds[first + 1]:.1f} s ({jumps.sum()} in all)',
        'publish odom of the wheels alone, without resets or corrections by a map',
        {'jumps': int(jumps.sum()), 'metres': float(moved[first])},
    )


def check_path(stream: Stream) -> Finding | None:
    """
    Compare the direction of the path with the yaw, which is right; None where they go together.

    A robot that drives along its heading, forwards and backwards, keeps the angle between the two;
    in a mirrored path it is their sum that stays.
    """
    _, values = steps_of(stream)
    moved = np.diff(values[:, 0]) + 1j * np.diff(values[:, 1])
    size = np.abs(moved)
    far = size > 0.2 * float(np.quantile(size, 0.9)) if len(size) else size > 0.0
    if far.sum() < _LEAST_STEPS or size.sum() < _LEAST_PATH_M:
        return None
    direction, weight = moved[far] / size[far], size[far] / size[far].sum()
    yaw = np.unwrap(values[:, 2])
    heading = np.exp(0.5j * (yaw[1:] + yaw[:-1]))[far]
    own = float(np.abs(np.sum(weight * (direction / heading) ** 2)))
    mirrored = float(np.abs(np.sum(weight * (direction * heading) ** 2)))
    if own > _CONTRADICTS or mirrored < _AGREES:
        return None
    # Mostly forwards: the sum is 0 with y mirrored, half a turn with x, a quarter with both
    # exchanged.
    sum_of_both = np.sum(weight * direction * heading)
    quarter = round(float(np.angle(sum_of_both)) / (0.5 * np.pi)) % 4
    text = ('y has the wrong sign', 'x and y are exchanged', 'x has the wrong sign')[quarter % 3]
    if quarter == 3:
        text = 'x and y are exchanged, with the wrong sign'
    return Finding(
        'odom path',
        'error',
        f'is mirrored: {text} beside the yaw',
        'publish x ahead, y to the left at yaw 0, yaw counter-clockwise (REP-103)',
        {'agrees': own, 'mirrored': mirrored},
    )
