"""Findings of what was estimated: a cause, an error of lens or mount, small errors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from landmark_nav.diagnosis.camera_errors import CameraError
from landmark_nav.diagnosis.causes import Cause, CLOCKS
from landmark_nav.diagnosis.findings import Code, Finding, Level, seconds_text
from landmark_nav.diagnosis.motion import ALIKE, Estimate, Linear, Motion
from landmark_nav.diagnosis.odometry import nearness_of_room, unit_of
from landmark_nav.diagnosis.streams import IMAGES, JOINTS, ODOMETRY
from landmark_nav.geometry.walls import Room

# Greatest delay that is corrected; beyond it, the joint angles are not known well enough.
CORRECTED_S = 0.3
# Greatest errors of the scales of pan, yaw and lens with which localization works.
_PAN_OFF, _YAW_OFF, _LENS_OFF = 0.1, 0.3, 0.1
# Bounds of the mean inverse distance of visible things, 1/m; outside them the unit is wrong.
_USUAL, _FAR, _NEAR = 0.3, 1.0 / 40.0, 3.0
# Greatest factor between the parallax in a known room and that of its walls: furniture is nearer.
_OF_ROOM = 2.2
# Heading errors of the camera that are a warning and an error.
_HEADING_WARN_RAD, HEADING_ERROR_RAD = np.radians(8.0), np.radians(20.0)
_BACKWARDS_RAD = np.radians(140.0)
# Greatest turn between two images of a stream that stays where it is.
_STAYS_RAD = 0.01
# Offset beyond which one clock is wall time and the other simulated time.
_WALL_TIME_S = 1e6
# Least value of a lens or mount error that is of level error: radians, or a share of the focal
# length.
_CAMERA_OFF = 0.14
# Greatest sigma of a clock that is judged by motion, and greatest offset that is normal.
_CLOCK_SIGMA_S, _CLOCK_WARN_S = 0.1, 0.05

_OTHERS = {IMAGES: 'joint_states and odom', JOINTS: 'images', ODOMETRY: 'images'}


def is_corrected(late: Estimate) -> bool:
    """Whether an offset is small enough to be corrected, or may be."""
    leeway_s = 3.0 * late.sigma if np.isfinite(late.sigma) else 0.0
    return abs(late.value) <= CORRECTED_S + leeway_s


def clock_finding(stream: str, late_s: float, how: str = '', *, corrected: bool) -> Finding:
    """Return the finding of a clock offset of a stream."""
    code = Code.WALL_TIME if abs(late_s) > _WALL_TIME_S else Code.CLOCK
    if corrected:
        of_images = Code.LATE_IMAGES if late_s > 0.0 else Code.LATE_OTHER
        code = {IMAGES: of_images, JOINTS: Code.LATE_JOINTS}.get(stream, Code.LATE_OTHER)
    return code.found(stream, _OTHERS[stream], how, late_s=late_s)


def step_finding(stream: str, step_s: float, at_s: float) -> Finding:
    """Build the finding of the clock of a stream that was set."""
    level: Level = 'error' if abs(step_s) > CORRECTED_S else 'warning'
    return Code.STEP.at(level, stream, step_s=step_s, at_s=at_s)


def cause_findings(cause: Cause) -> list[Finding]:
    """Return the finding of the likeliest fault, with its equivalent alternatives."""
    if cause.kind == 'none':
        return [] if cause.fits else [_undecided(cause)]
    *others, finding = [
        clock_finding(stream, late.value, corrected=is_corrected(late))
        for stream, late in reversed(cause.late.items())
    ] or [_named(cause)]
    if cause.rivals:
        kinds = {(c.stream, 'clock' if c.kind in CLOCKS else c.kind) for c in cause.rivals}
        also = ', '.join(sorted(map(' '.join, kinds)))
        finding = replace(finding, measured=f'{finding.measured} (or {also}: undecided)')
        if cause.stream == JOINTS and cause.value < 0.0 and (IMAGES, 'clock') in kinds:
            late = f'; if images are late, also {-cause.value:+.3f} to image_delay'
            finding = replace(finding, advice=finding.advice + late)
    return [*others, finding]


def _undecided(cause: Cause) -> Finding:
    motion = cause.motion
    streams = [(JOINTS, 'the pan does not move')]
    streams += [(ODOMETRY, 'its heading does not change')] if motion.odometry is not None else []
    for stream, what in streams:
        if np.abs(motion.turned(stream)).max(initial=0.0) < _STAYS_RAD:
            return Code.HANGS.found(stream, what)
    return Code.UNDECIDED.found(noise_rad=cause.left.noise_rad)


# Code of a kind of cause, and the name of its value.
_CAUSES = {
    'twist': (Code.YAW_TWIST, ''),
    'speed': (Code.PAN_SPEED, ''),
    'heading': (Code.PAN_FRAME, ''),
    'upside down': (Code.UPSIDE_DOWN, ''),
    'filter': (Code.PAN_FILTER, 'filter_s'),
    'offset': (Code.OFFSET, 'offset_m'),
    'ahead': (Code.AXIS_AHEAD, 'ahead_m'),
    'left': (Code.AXIS_LEFT, 'left_m'),
}


def _named(cause: Cause) -> Finding:
    stream, value, kind = cause.stream, cause.value, cause.kind
    if kind == 'drift':
        share, off_s = 100.0 * abs(value), abs(cause.offset_s)
        rate = f'{share:.1f} %' if share < 1e3 else f'{1.0 + value:.4g} times'
        start = f', {seconds_text(off_s)} off at the start' if off_s > 1.0 else ''
        words = stream, _OTHERS[stream], rate, start
        return Code.DRIFT.found(*words, drift=value, offset_s=cause.offset_s)
    if kind == 'step':
        return step_finding(stream, value, cause.offset_s)
    if kind == 'joint':
        return Code.OTHER_JOINT.found(pan_joint=cause.name)
    if kind == 'bias':
        return Code.YAW_DRIFT.found(bias_rad_s=-value)
    if kind == 'curve':
        return Code.YAW_CURVE.found(curve_rad_m=-value)
    if kind == 'scale':
        return _scaled(stream, value)
    code, name = _CAUSES[kind]
    return code.found(**({name: value} if name else {}))


def _scaled(stream: str, factor: float) -> Finding:
    """Return the finding of a stream that has to be multiplied by `factor` to fit the images."""
    times = 1.0 / factor if abs(factor) > 1e-9 else np.inf
    off, least = abs(times - 1.0), 0.0
    if stream == JOINTS:
        code, least = Code.PAN_SCALE, _PAN_OFF
        if abs(factor + 1.0) < 0.15:
            code = Code.PAN_SIGN
        elif abs(np.degrees(abs(factor)) - 1.0) < 0.15:
            code = Code.PAN_DEGREES
        elif abs(factor) < 1e-4:
            code = Code.PAN_ALONE
    elif stream == ODOMETRY:
        code, least = Code.YAW_SCALE, _YAW_OFF
        if abs(factor + 1.0) < 0.35:
            code = Code.YAW_SIGN
        elif not 0.05 <= abs(factor) <= 20.0:
            code = Code.YAW_ALONE
    elif abs(factor + 1.0) < 0.2:
        return Code.IMAGES_SIGN.found(scale=factor)
    else:
        level: Level = 'error' if off > _LENS_OFF else 'warning'
        words = 100.0 * off, 'long' if times > 1.0 else 'short'
        return Code.IMAGES_SCALE.at(level, *words, scale=factor)
    return code.at('error' if off > least else 'warning', scale=times)


def camera_finding(error: CameraError) -> Finding:
    """Return the finding of an error of lens or mount."""
    value, camera, mount = error.value, error.setup.camera, error.setup.mount
    words = {
        'axis': ', '.join(f'{angle:.3f}' for angle in mount.axis_rpy),
        'roll': f'{mount.camera_roll_rad:.4f}',
        'cx': f'{abs(value) * camera.fx:.0f}',
        'cy': f'{abs(value) * camera.fy:.0f}',
    }
    word = words.get(error.name.partition(' ')[0], f'{100.0 * abs(np.expm1(-value)):.0f}')
    level: Level = 'error' if abs(value) > _CAMERA_OFF else 'warning'
    found = Code[error.name.upper().replace(' ', '_')].at(level, word, value=value)
    if error.also:
        text = f'{found.measured} (or {", ".join(error.also)}: undecided)'
        found = replace(found, measured=text)
    return found


def motion_findings(motion: Motion, slopes: Linear, room: Room | None) -> list[Finding]:
    """Judge scales, clocks, unit of the odometry and heading of the camera by the images."""
    found = [_scale('pan scale', 'gear of the pan', slopes.pan_scale, 0.05, 0.03)]
    clocks = [_clock(JOINTS, slopes.pan_clock_s)]
    if motion.odometry is not None:
        track = 'track width of the wheels'
        found.append(_scale('odom yaw', track, slopes.yaw_scale, 0.1, 0.15))
        clocks.append(_clock(ODOMETRY, slopes.odometry_clock_s))
    more = [*_unit(slopes, room), *_heading(slopes)]
    said = {finding.name for finding in more}
    return [*(finding for finding in found + clocks if finding.name not in said), *more]


def _scale(name: str, what: str, error: Estimate, known: float, warn: float) -> Finding:
    """Return the finding of a relative error, judged if its sigma is less than `known`."""
    if error.sigma > known:
        return Code.SCALE_UNKNOWN.found(name)
    level: Level = 'warning' if error.beyond(warn, known) else 'ok'
    return Code.SCALE.at(level, name, what, scale=1.0 + error.value, sigma=error.sigma)


def _clock(stream: str, late: Estimate) -> Finding:
    if late.sigma > _CLOCK_SIGMA_S:
        return Code.CLOCK_UNKNOWN.found(stream)
    words = stream, 1e3 * late.value, 1e3 * late.sigma
    level: Level = 'warning' if late.beyond(_CLOCK_WARN_S, _CLOCK_SIGMA_S) else 'ok'
    return Code.CLOCK_MEASURED.at(level, *words, late_s=late.value, sigma_s=late.sigma)


def _unit(slopes: Linear, room: Room | None) -> Iterator[Finding]:
    """Judge the unit of the odometry by parallax."""
    size, sigma = slopes.parallax
    if not np.isfinite(sigma) or size < 1e-9:
        return
    usual, low, high = _USUAL, _FAR, _NEAR
    if room is not None and np.isfinite(expected := nearness_of_room(room)):
        usual, low, high = expected, expected / _OF_ROOM, expected * _OF_ROOM
    values = {'nearness_per_m': size, 'sigma_per_m': sigma}
    most = size + 4.0 * sigma
    if most < low or size - 4.0 * sigma > high:
        unit = unit_of(usual / size)
        like = f', as if in {unit}' if unit else ''
        remedy = '' if unit else '; check the radius of the wheels'
        # What is outside of windows is farther than a room.
        level: Level = 'warning' if _FAR <= most < low else 'error'
        yield Code.UNIT.at(level, usual / size, like, remedy, **values)
    elif size > 4.0 * sigma:
        yield Code.DISTANCE.found(1.0 / size, **values)


def _heading(slopes: Linear) -> Iterator[Finding]:
    """Judge the direction of the odometry and the heading of the camera by parallax."""
    size, sigma = slopes.parallax
    if not np.isfinite(sigma) or size < max(6.0 * sigma, 1e-9):
        return
    turned, spread = slopes.heading_rad
    off_rad = abs(turned) if abs(turned) > 3.0 * spread else 0.0
    code: Code = Code.HEADING
    level: Level = 'ok'
    if abs(turned) - 4.0 * spread > _BACKWARDS_RAD:
        code, level = Code.BACKWARDS, 'error'
    elif off_rad > _HEADING_WARN_RAD and slopes.straight > ALIKE:
        yield Code.YAW_CURVE.at('warning', curve_rad_m=-slopes.curved_rad_m)
        return
    elif off_rad > HEADING_ERROR_RAD:
        level = 'error'
    elif off_rad > _HEADING_WARN_RAD:
        code = Code.HEADING_OR_CURVE if slopes.straight > -ALIKE else Code.HEADING
        level = 'warning'
    yield code.at(level, heading_rad=turned, sigma_rad=spread)
