"""The path of an odometry: whether it jumps, and whether it leads where the robot heads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from landmark_nav.arrays import FloatArray
from landmark_nav.diagnosis.findings import Finding
from landmark_nav.diagnosis.streams import Stream
from landmark_nav.diagnosis.units import steps_of

# A step is a jump if it is so many times the usual ones, and metres or radians.
_JUMP, _JUMP_M, _JUMP_RAD = 10.0, 0.3, 0.5
# More of them are no jumps but a source that is noisy, or two.
_MOST_JUMPS = 5
# How well directions of steps agree with the heading, of 1: that of a path in its own axes at
# least, and that of one in other axes at most.
_AGREES, _CONTRADICTS = 0.9, 0.7
_LEAST_PATH_M, _LEAST_STEPS = 0.5, 8
_ASIDE_RAD = np.radians(20.0)


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


class Path(NamedTuple):
    """What is wrong with a path, and the values (n, k) of its stream without that."""

    finding: Finding
    mended: FloatArray


def check_path(stream: Stream) -> Path | None:
    """
    Compare the direction of the path with the yaw; None where they go together.

    A robot that drives along its heading, forwards and backwards, keeps the angle between the two;
    in a mirrored path it is their sum that stays. Either the path is turned or mirrored, or the
    heading is another: whatever explains the images.
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
    aside = float(np.angle(np.sum(weight * direction / heading)))  # mostly forwards
    # A robot may well drive backwards; one that drives straight shows nothing.
    turned = min(abs(aside), np.pi - abs(aside)) > _ASIDE_RAD
    if own > _AGREES >= mirrored and turned:
        finding = Finding(
            'odom path',
            'error',
            f'leads {abs(np.degrees(aside)):.0f} deg aside of the yaw',
            'publish x ahead, y to the left at yaw 0 (REP-103), not in a frame that is turned',
            {'aside_rad': aside},
        )
        return _mended(stream, finding, lambda place: place * np.exp(-1j * aside))
    if own > _CONTRADICTS or mirrored < _AGREES:
        return None
    # The sum is 0 with y mirrored, half a turn with x, a quarter with both
    # exchanged.
    sum_of_both = np.sum(weight * direction * heading)
    quarter = round(float(np.angle(sum_of_both)) / (0.5 * np.pi)) % 4
    text = ('y has the wrong sign', 'x and y are exchanged', 'x has the wrong sign')[quarter % 3]
    if quarter == 3:
        text = 'x and y are exchanged, with the wrong sign'
    finding = Finding(
        'odom path',
        'error',
        f'is mirrored: {text} beside the yaw',
        'publish x ahead, y to the left at yaw 0, yaw counter-clockwise (REP-103)',
        {'agrees': own, 'mirrored': mirrored},
    )
    return _mended(stream, finding, lambda place: 1j**quarter * np.conj(place))


def _mended(stream: Stream, finding: Finding, change: Callable[[Any], Any]) -> Path:
    place = change(stream.values[:, 0] + 1j * stream.values[:, 1])
    values = stream.values.copy()
    values[:, 0], values[:, 1] = place.real, place.imag
    return Path(finding, values)
