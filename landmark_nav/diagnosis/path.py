"""The path of odometry: whether it jumps, and whether it follows the heading."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from landmark_nav.arrays import FloatArray
from landmark_nav.diagnosis.findings import Finding
from landmark_nav.diagnosis.streams import Stream
from landmark_nav.diagnosis.units import steps_of

# A jump exceeds the usual speed (95 % quantile) by this factor, and these metres or radians.
_JUMP, _JUMP_M, _JUMP_RAD = 10.0, 0.3, 0.5
# More jumps than these come from a noisy source, or from two sources.
_MOST_JUMPS = 5
# Agreement of the directions of steps with the heading, 0 to 1: least of correct axes, greatest
# of wrong axes.
_AGREES, _CONTRADICTS = 0.9, 0.7
_LEAST_PATH_M, _LEAST_STEPS = 0.5, 8
# Greatest angle between path and heading in correct axes.
_ASIDE_RAD = np.radians(20.0)


def check_jumps(stream: Stream) -> Finding | None:
    """Find impossible steps of odometry (x, y, yaw, ...); None if there are none."""
    if len(stream) < _LEAST_STEPS:
        return None
    moved = np.hypot(*np.diff(stream.values[:, :2], axis=0).T)
    turned = np.abs(np.angle(np.exp(1j * np.diff(stream.values[:, 2]))))
    # A step over a gap takes longer and may be larger.
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
    """Fault of a path, and the values (n, k) of its stream without the fault."""

    finding: Finding
    mended: FloatArray


def check_path(stream: Stream) -> Path | None:
    """
    Compare the direction of the path with the yaw; None if they agree.

    A robot that drives along its heading, forwards and backwards, keeps the angle between the two;
    in a mirrored path their sum is constant. The fault is in the path or in the heading; the
    caller decides by the images.
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
    # The robot may drive backwards; a straight path does not show a mirrored one.
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
    # The sum is 0 if y is mirrored, half a turn if x is, a quarter if both are exchanged.
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
