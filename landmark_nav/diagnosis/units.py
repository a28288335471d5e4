"""Units and signs of odometry, judged by its own values or by the room."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from landmark_nav.arrays import FloatArray
from landmark_nav.diagnosis.findings import Finding
from landmark_nav.diagnosis.streams import Stream
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


def unit_of(factor: float, units: Mapping[str, float] = _UNITS) -> str:
    """Name of the unit in which numbers are `factor` times those of SI; empty if none."""
    for name, known in units.items():
        if 0.7 * known < factor < known / 0.7:
            return name
    return ''


def steps_of(stream: Stream) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and values (n, 5) at about equal steps of `_STEP_S` or more."""
    times = stream.seconds
    rising = np.append(True, np.diff(times) > 0.0)
    times, values = times[rising], stream.values[rising]
    period = float(np.median(np.diff(times))) if len(times) > 1 else _STEP_S
    every = max(1, round(_STEP_S / max(period, 1e-3)))
    return times[::every], values[::every]


def check_speed(stream: Stream) -> Finding:
    """Check the speed by the poses of odometry (x, y, yaw, forward speed, yaw rate)."""
    times, values = steps_of(stream)
    steps = np.hypot(*np.diff(values[:, :2], axis=0).T) / np.diff(times)
    speed = float(np.quantile(steps, 0.9)) if len(steps) else 0.0
    text = f'{speed:.2f} m/s (90 %)'
    if speed > _FAST_M_S:
        advice = 'publish odom in metres; by its speed it looks like centimetres or millimetres'
        level = 'error' if speed > _FASTEST_M_S else 'warning'
        return Finding('odom speed', level, text, advice, {'speed_m_s': speed})  # type: ignore[arg-type]
    return Finding('odom speed', 'ok', text, '', {'speed_m_s': speed})


def check_twist(stream: Stream) -> list[Finding]:
    """Compare the twists of odometry with its poses: unit and sign."""
    times, values = stream.seconds, stream.values
    steps = np.diff(times)
    good = (steps > 0.0) & (steps < 1.0)
    if not good.any() or not np.abs(values[:, 3:5]).max() > 0.0:
        return []
    moved = np.diff(values[:, :2], axis=0)
    heading = 0.5 * (values[1:, 2] + values[:-1, 2])
    forward = np.cos(heading) * moved[:, 0] + np.sin(heading) * moved[:, 1]
    turned = np.diff(values[:, 2])
    turned = np.arctan2(np.sin(turned), np.cos(turned))
    found = []
    for name, by_pose, column, least in (
        ('forward', forward, 3, _LEAST_MOTION_M),
        ('turn', turned, 4, _LEAST_MOTION_RAD),
    ):
        by_twist = 0.5 * (values[1:, column] + values[:-1, column]) * steps
        # Single jumps are reported by `check_jumps`.
        usual = good & (np.abs(by_pose) <= np.quantile(np.abs(by_pose[good]), _USUAL))
        pose, twist = by_pose[usual], by_twist[usual]
        if max(np.abs(pose).sum(), np.abs(twist).sum()) < least:
            continue
        size = float(np.abs(pose).sum() / max(np.abs(twist).sum(), 1e-9))
        sign = -1.0 if float(pose @ twist) < 0.0 else 1.0
        ratio = sign * size
        text = (
            f'pose moves {ratio:.3g} times its twist'
            if name == 'forward'
            else (f'pose turns {ratio:.3g} times its twist')
        )
        if 1.0 / _ALIKE < ratio < _ALIKE:
            found.append(Finding(f'odom twist, {name}', 'ok', text, '', {'ratio': ratio}))
            continue
        units = _UNITS if name == 'forward' else _ANGLES
        unit = unit_of(size, units) or unit_of(1.0 / max(size, 1e-9), units)
        if ratio < 0.0:
            advice = 'pose and twist have opposite signs: publish both by REP-103'
        elif size < 1e-3:
            advice = 'the pose stands while the twist moves: publish the integrated pose'
        elif unit:
            which = 'pose' if size > 1.0 else 'twist'
            advice = f'the {which} looks like {unit}: publish metres and radians'
        else:
            advice = 'pose and twist contradict each other: look at the scale of both'
        found.append(Finding(f'odom twist, {name}', 'warning', text, advice, {'ratio': ratio}))
    return found


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
