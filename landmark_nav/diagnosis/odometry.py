"""Odometry by its own values: units, signs, jumps, and whether its path follows the yaw."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from landmark_nav.arrays import FloatArray
from landmark_nav.diagnosis.findings import Code, Finding, Level
from landmark_nav.diagnosis.streams import Stream
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Room

# Speeds that are suspicious for a robot indoors, and impossible.
_FAST_M_S, _FASTEST_M_S = 3.0, 10.0
# Least time of a step; in shorter ones noise dominates the speed.
_STEP_S = 0.2
# Least path and turn with which pose and twist are compared.
_LEAST_MOTION_M, _LEAST_MOTION_RAD = 0.3, 0.3
# Ratio up to which pose and twist agree.
_ALIKE = 1.25
# Quantile of the steps that are compared; larger ones are jumps.
_USUAL = 0.98
_ANGLES = {'degrees': 57.2958, 'revolutions': 1.0 / (2.0 * np.pi)}
_UNITS = {'centimetres': 100.0, 'millimetres': 1000.0, 'inches': 39.37, 'feet': 3.281}
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


def unit_of(factor: float, units: Mapping[str, float] = _UNITS) -> str:
    """Name of the unit in which numbers are `factor` times those of SI; empty if none."""
    near = (name for name, known in units.items() if 0.7 * known < factor < known / 0.7)
    return next(near, '')


def _steps_of(stream: Stream) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and values (n, 5) at about equal steps of `_STEP_S` or more."""
    times, order = np.unique(stream.seconds, return_index=True)
    values = stream.values[order]
    period = float(np.median(np.diff(times))) if len(times) > 1 else _STEP_S
    every = max(1, round(_STEP_S / max(period, 1e-3)))
    return times[::every], values[::every]


def check_speed(stream: Stream) -> Finding:
    """Check the speed by the poses of odometry (x, y, yaw, forward speed, yaw rate)."""
    times, values = _steps_of(stream)
    steps = np.hypot(*np.diff(values[:, :2], axis=0).T) / np.diff(times)
    speed = float(np.quantile(steps, 0.9)) if len(steps) else 0.0
    level: Level = 'error' if speed > _FASTEST_M_S else 'warning' if speed > _FAST_M_S else 'ok'
    return Code.SPEED.at(level, speed_m_s=speed)


def check_twist(stream: Stream) -> Iterator[Finding]:
    """Compare the twists of odometry with its poses: unit and sign."""
    values, steps = stream.values, np.diff(stream.seconds)
    good = (steps > 0.0) & (steps < 1.0)
    if not good.any() or not np.abs(values[:, 3:5]).max() > 0.0:
        return
    moved = np.diff(values[:, 0] + 1j * values[:, 1])
    forward = (moved * np.exp(-0.5j * (values[1:, 2] + values[:-1, 2]))).real
    for name, verb, by_pose, column, least, units in (
        ('forward', 'moves', forward, 3, _LEAST_MOTION_M, _UNITS),
        ('turn', 'turns', wrap_rad(np.diff(values[:, 2])), 4, _LEAST_MOTION_RAD, _ANGLES),
    ):
        by_twist = 0.5 * (values[1:, column] + values[:-1, column]) * steps
        # Single jumps are reported by `check_jumps`.
        usual = good & (np.abs(by_pose) <= np.quantile(np.abs(by_pose[good]), _USUAL))
        pose, twist = by_pose[usual], by_twist[usual]
        if max(np.abs(pose).sum(), np.abs(twist).sum()) < least:
            continue
        size = float(np.abs(pose).sum() / max(np.abs(twist).sum(), 1e-9))
        both = float(pose @ twist)
        opposite = both < -_AGREES * float(np.sqrt((pose @ pose) * (twist @ twist)))
        # With noise in both, the ratio lies between their regressions on each other.
        low, high = both / max(float(twist @ twist), 1e-12), float(pose @ pose) / max(both, 1e-12)
        agree = both > 0.0 and low < _ALIKE and high > 1.0 / _ALIKE
        code, unit = Code.TWIST, ''
        if opposite:
            code = Code.TWIST_OPPOSITE
        elif size < 1e-3:
            code = Code.TWIST_ALONE
        elif unit := unit_of(size, units) or unit_of(1.0 / size, units):
            code = Code.TWIST_UNIT
        words = name, verb, 'pose' if size > 1.0 else 'twist', unit
        ratio = -size if opposite else size
        yield code.at('ok' if agree else 'warning', *words, ratio=ratio)


def nearness_of_room(room: Room) -> float:
    """
    Mean inverse distance of the walls, 1/m, over the floor and all directions.

    It is the expected parallax of a camera at an unknown pose in the room.
    """
    low, high = room.bounds
    share = np.linspace(0.2, 0.8, 5)
    spots = low + (high - low) * np.stack(np.meshgrid(share, share), -1).reshape(-1, 2)
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    inside = spots[room.contains(spots)]
    distance, _ = room.raycast(inside[:, None], angles[None])
    return float(np.mean(1.0 / np.maximum(distance, 0.3))) if len(inside) else float('nan')


def check_jumps(stream: Stream) -> Iterator[Finding]:
    """Find impossible steps of odometry (x, y, yaw, ...)."""
    if len(stream) < _LEAST_STEPS:
        return
    moved = np.hypot(*np.diff(stream.values[:, :2], axis=0).T)
    turned = np.abs(wrap_rad(np.diff(stream.values[:, 2])))
    # A step over a gap takes longer and may be larger.
    times = np.maximum(np.diff(stream.seconds), float(np.median(np.diff(stream.seconds))))
    jumps = np.zeros(len(moved), dtype=np.bool_)
    for size, least in ((moved, _JUMP_M), (turned, _JUMP_RAD)):
        speed = size / np.maximum(times, 1e-6)
        jumps |= (size > least) & (speed > _JUMP * float(np.quantile(speed, 0.95)))
    first, count = int(np.argmax(jumps)), int(jumps.sum())
    if 0 < count <= _MOST_JUMPS:
        words = turned[first], stream.seconds[first + 1]
        yield Code.JUMPS.found(*words, jumps=count, metres=float(moved[first]))


def check_path(stream: Stream) -> tuple[Finding, FloatArray] | None:
    """
    Compare the direction of the path with the yaw; None if they agree.

    Returns the fault of the path, and the values (n, k) of the stream without it.

    A robot that drives along its heading, forwards and backwards, keeps the angle between the two;
    in a mirrored path their sum is constant. The fault is in the path or in the heading; the
    caller decides by the images.
    """
    _, values = _steps_of(stream)
    moved = np.diff(values[:, 0] + 1j * values[:, 1])
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
    place = stream.values[:, 0] + 1j * stream.values[:, 1]
    # The robot may drive backwards; a straight path does not show a mirrored one.
    turned = min(abs(aside), np.pi - abs(aside)) > _ASIDE_RAD
    if own > _AGREES >= mirrored and turned:
        place, found = place * np.exp(-1j * aside), Code.PATH_ASIDE.found(aside_rad=aside)
    elif own > _CONTRADICTS or mirrored < _AGREES:
        return None
    else:
        # The sum is 0 if y is mirrored, half a turn if x is, a quarter if both are exchanged.
        sum_of_both = np.sum(weight * direction * heading)
        quarter = round(float(np.angle(sum_of_both)) / (0.5 * np.pi)) % 4
        wrong = (
            'y has the wrong sign',
            'x and y are exchanged',
            'x has the wrong sign',
            'x and y are exchanged, with the wrong sign',
        )[quarter]
        place = 1j**quarter * np.conj(place)
        found = Code.PATH_MIRRORED.found(wrong, agrees=own, mirrored=mirrored)
    values = np.column_stack([place.real, place.imag, stream.values[:, 2:]])
    return found, values
