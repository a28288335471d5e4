"""Findings of motion in words: a fault, its magnitude, and the remedy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from landmark_nav.diagnosis.camera_errors import CameraError
from landmark_nav.diagnosis.causes import ALIKE, Cause, IMAGES, JOINTS, ODOMETRY, Verdict
from landmark_nav.diagnosis.findings import Finding, Level
from landmark_nav.diagnosis.motion import Estimate, Linear, Motion
from landmark_nav.diagnosis.units import nearness_of_room, unit_of
from landmark_nav.geometry.walls import Room

# Greatest delay that is corrected; beyond it, the joint angles are not known well enough.
CORRECTED_S = 0.3
# Greatest errors of the scales of pan and yaw with which localization works.
_PAN_OFF, _YAW_OFF = 0.1, 0.3
# Bounds of the mean inverse distance of visible things, 1/m; outside them the unit is wrong.
_FAR, _NEAR = 1.0 / 40.0, 3.0
# Greatest factor between the parallax in a known room and that of its walls: furniture is nearer.
_OF_ROOM = 2.2
# Heading errors of the camera that are a warning and an error.
_HEADING_WARN_RAD, HEADING_ERROR_RAD = np.radians(8.0), np.radians(20.0)
# Offset beyond which one clock is wall time and the other simulated time.
_WALL_TIME_S = 1e6

_WHEELS = 'calibrate the radii of the wheels, on a straight line'

_OTHERS = {
    IMAGES: 'joint_states and odom',
    JOINTS: 'images',
    ODOMETRY: 'images',
}


def clock_finding(stream: str, late_s: float, how: str = '', *, corrected: bool = True) -> Finding:
    """Return the finding of a clock offset of a stream."""
    side = 'late' if late_s > 0.0 else 'early'
    against = _OTHERS[stream]
    text = f'stamped {seconds_text(abs(late_s))} {side} against {against}{how}'
    values = {'late_s': late_s}
    if corrected and abs(late_s) <= CORRECTED_S:
        advice = 'corrected here; on the robot stamp at the time of measurement'
        # `evaluate` reports the joint delay more accurately in a separate line.
        by_map = stream == JOINTS
        if by_map:
            advice = f'corrected here; in robot.yaml set joint_delay to {late_s:.3f}'
        return Finding(f'{stream} clock', 'warning', text, advice, values, by_map)
    advice = (
        'wall time beside simulated time: set use_sim_time alike everywhere'
        if abs(late_s) > _WALL_TIME_S
        else 'stamp all streams by one clock (chrony), at the time of measurement'
    )
    return Finding(f'{stream} clock', 'error', text, advice, values)


def seconds_text(seconds: float) -> str:
    """Format a time for people."""
    if seconds < 1.0:
        return f'{1e3 * seconds:.0f} ms'
    return f'{seconds:.2f} s' if seconds < 1e5 else f'{seconds:.6g} s'


def cause_findings(judged: Verdict) -> list[Finding]:
    """Return the finding of the likeliest fault, with its equivalent alternatives."""
    cause = judged.cause
    if cause.kind == 'none':
        if judged.fits:
            return []
        noise = np.degrees(cause.left.noise_rad)
        return [
            Finding(
                'image motion',
                'warning',
                f'no single fault explains how the images turn ({noise:.1f} deg are left)',
                'undecided: look at joint_states, odom and images; more than one may be off',
                {'noise_rad': cause.left.noise_rad},
            )
        ]
    finding = _named(cause)
    if judged.rivals:
        also = ', '.join(sorted({_short(rival) for rival in judged.rivals}))
        finding = replace(finding, measured=f'{finding.measured} (or {also}: undecided)')
    return [finding]


# Least value of a lens or mount error that is of level error: radians, or a share of the focal
# length.
_CAMERA_OFF = 0.14
_ZOOM = 'calibrate the camera at the size and zoom that are published'
_SQUARE = 'calibrate again: pixels are square, if the driver does not stretch images'


def camera_finding(error: CameraError) -> Finding:
    """Return the finding of an error of lens or mount."""
    value, camera, mount = error.value, error.setup.camera, error.setup.mount
    degrees = abs(np.degrees(value))
    rpy = ', '.join(f'{angle:.3f}' for angle in mount.axis_rpy)
    share = 100.0 * abs(np.expm1(-value))
    of_lens = {
        name: (
            'camera lens',
            f'{what} in camera_info is {share:.0f} % too {"short" if value > 0.0 else "long"}',
            advice,
        )
        for name, what, advice in (
            ('focal length', 'the focal length', _ZOOM),
            ('fx', 'fx', _SQUARE),
            ('fy', 'fy', _SQUARE),
        )
    }
    name, text, advice = {
        **of_lens,
        'size': (
            'camera lens',
            f'its K is of images {share:.0f} % {"smaller" if value > 0.0 else "larger"}',
            'publish K of the size that is published, or binning and roi with K of the full image',
        ),
        'tilt': (
            'camera tilt',
            f'looks {degrees:.0f} deg {"higher" if value > 0.0 else "lower"} than mount and tilt '
            'say',
            'fix the zero of the tilt, or pan_axis rpy (pitch) in robot.yaml',
        ),
        'axis pitch': (
            'camera mount',
            f'the pitch of pan_axis is off by {degrees:.0f} deg',
            f'set pan_axis rpy: [{rpy}] in robot.yaml',
        ),
        'axis roll': (
            'camera mount',
            f'the roll of pan_axis is off by {degrees:.0f} deg',
            f'set pan_axis rpy: [{rpy}] in robot.yaml',
        ),
        'roll': (
            'camera roll',
            f'images are turned by {np.degrees(value):.0f} deg',
            f'set camera_roll: {mount.camera_roll_rad:.4f} in robot.yaml, or turn them',
        ),
        'cx': (
            'camera lens',
            f'the principal point is {abs(value) * camera.fx:.0f} px farther '
            f'{"right" if value > 0.0 else "left"} than cx in camera_info',
            'calibrate again; images that are cropped need cx of the part that is left',
        ),
        'cy': (
            'camera lens',
            f'the principal point is {abs(value) * camera.fy:.0f} px farther '
            f'{"down" if value > 0.0 else "up"} than cy in camera_info',
            'calibrate again; images that are cropped need cy of the part that is left',
        ),
        'distortion': (
            'camera lens',
            f'its distortion is not that in camera_info: k1 is off by {abs(value):.2f}',
            'calibrate the camera that is mounted, and publish d with raw images',
        ),
    }[error.name]
    if error.also:
        text += f' (or {", ".join(error.also)}: undecided)'
    level: Level = 'error' if abs(value) > _CAMERA_OFF else 'warning'
    return Finding(name, level, text, advice, {'value': value})


def _short(cause: Cause) -> str:
    what = {'clock': 'clock', 'drift': 'clock', 'step': 'clock', 'scale': 'scale'}.get(
        cause.kind, cause.kind
    )
    return f'{cause.stream} {what}'


def _named(cause: Cause) -> Finding:
    stream, value = cause.stream, cause.value
    if cause.kind == 'clock':
        return clock_finding(stream, value)
    if cause.kind == 'drift':
        fast = 'fast' if value > 0.0 else 'slow'
        at = f', {seconds_text(abs(cause.offset_s))} off at the start'
        share = 100.0 * abs(value)
        text = f'{share:.1f} %' if share < 1e3 else f'{1.0 + value:.4g} times'
        return Finding(
            f'{stream} clock',
            'error',
            f'runs {text} {fast} against {_OTHERS[stream]}{at if abs(cause.offset_s) > 1 else ""}',
            'its stamps drift: stamp by the clock of the host, disciplined by chrony',
            {'drift': value, 'offset_s': cause.offset_s},
        )
    if cause.kind == 'step':
        side = 'ahead' if value > 0.0 else 'back'
        return Finding(
            f'{stream} clock',
            'error' if abs(value) > CORRECTED_S else 'warning',
            f'steps {side} by {seconds_text(abs(value))} at {cause.offset_s:.1f} s',
            'discipline the clock of its host before driving (chrony)',
            {'step_s': value, 'at_s': cause.offset_s},
        )
    degrees, away, ahead = np.degrees(-value), abs(value), value > 0.0
    left = cause.kind == 'left'
    sides = ('to the left', 'to the right') if left else ('ahead', 'behind')
    lever = (
        'camera mount',
        f'the pan axis is {away:.1f} m {sides[not ahead]} of where robot.yaml has it',
        'measure pan_axis xyz: metres ahead, to the left and up of base_link',
        {f'{cause.kind}_m': value},
    )
    described: dict[str, tuple[str, str, str, dict[str, Any]]] = {
        'joint': (
            'joint names',
            f'joint {cause.name} turns as the camera does, that of robot.yaml does not',
            f'set pan_joint: {cause.name} in robot.yaml',
            {'pan_joint': cause.name},
        ),
        'twist': (
            'odom yaw',
            'its pose does not turn as the camera does, its twist does',
            'publish the pose that the twist sums up to',
            {},
        ),
        'speed': (
            'pan unit',
            'summed up, the pan is what the images turn by: it holds speeds, not angles',
            'publish angles as position in joint_states',
            {},
        ),
        'filter': (
            'pan filter',
            f'the pan follows the images as behind a filter of {away:.2f} s',
            'publish what the encoder measures, not what a controller or a smoother makes of it',
            {'filter_s': value},
        ),
        'heading': (
            'pan frame',
            'the pan has the yaw of odom in it: it is an angle against the room',
            'publish the angle of the joint, against the robot',
            {},
        ),
        'bias': (
            'odom yaw',
            f'drifts by {degrees:.1f} deg/s against the images',
            'calibrate the gyro while the robot stands',
            {'bias_rad_s': -value},
        ),
        'curve': (
            'odom yaw',
            f'curves by {degrees:.0f} deg/m against the images',
            _WHEELS,
            {'curve_rad_m': -value},
        ),
        'upside down': (
            'camera mount',
            'the images show the camera the other way up than robot.yaml: upside down, or not',
            'fix pan_axis rpy (a unit that hangs: [3.1416, 0, 0]) or camera_roll in robot.yaml',
            {},
        ),
        'offset': (
            'camera mount',
            f'the optical centre is {away:.2f} m {"ahead" if ahead else "behind"} of where '
            'robot.yaml has it',
            'measure optical_center_offset from the pan axis, in metres',
            {'offset_m': value},
        ),
        'ahead': lever,
        'left': lever,
    }
    if cause.kind in described:
        name, text, advice, values = described[cause.kind]
        return Finding(name, 'error', text, advice, values)
    return {JOINTS: _pan_scale, ODOMETRY: _yaw_scale, IMAGES: _image_scale}[stream](value)


def _pan_scale(factor: float) -> Finding:
    """Return the finding of a pan that has to be multiplied by `factor` to fit the images."""
    text = 1.0 / factor if abs(factor) > 1e-9 else np.inf
    values = {'scale': text}
    name = 'pan scale'
    if abs(factor + 1.0) < 0.15:
        return Finding(
            'pan sign',
            'error',
            'the images turn against the pan: its sign is reversed',
            'negate the pan, unmirror images, or set camera_roll: 3.1416 if upside down',
            values,
        )
    if abs(abs(factor) * 180.0 / np.pi - 1.0) < 0.15:
        return Finding(
            name,
            'error',
            f'the pan moves {text:.1f} times as far as the images turn: degrees',
            'publish joint_states in radians',
            values,
        )
    if abs(factor) < 1e-4:
        return Finding(
            'pan scale',
            'error',
            'the images do not turn with the pan',
            'check pan_joint in robot.yaml and the driver of the joints',
            values,
        )
    off = abs(text - 1.0)
    level: Level = 'error' if off > _PAN_OFF else 'warning'
    return Finding(
        name,
        level,
        f'the pan moves {text:.3g} times as far as the images turn',
        'check the gear or unit of the pan; else the focal length in camera_info',
        values,
    )


def _yaw_scale(factor: float) -> Finding:
    text = 1.0 / factor if abs(factor) > 1e-9 else np.inf
    values = {'scale': text}
    if abs(factor + 1.0) < 0.35:
        return Finding(
            'odom yaw',
            'error',
            'the images turn against its yaw: the sign of the yaw is reversed',
            'yaw is counter-clockwise: check the sides and signs of the wheels',
            values,
        )
    if abs(factor) < 0.05 or abs(factor) > 20.0:
        return Finding(
            'odom yaw',
            'error',
            f'turns {text:.3g} times as far as the images',
            'the yaw does not follow the robot: publish the integrated heading in radians',
            values,
        )
    level: Level = 'error' if abs(text - 1.0) > _YAW_OFF else 'warning'
    return Finding(
        'odom yaw',
        level,
        f'turns {text:.3g} times as far as the images',
        'check the track width of the wheels, and the unit of the heading',
        values,
    )


def _image_scale(seen: float) -> Finding:
    """Return the finding of images that turn `seen` times as far as joints and odometry."""
    if abs(seen + 1.0) < 0.2:
        return Finding(
            'images sign',
            'error',
            'turn against both pan and odometry: mirrored or upside down',
            'do not flip images; for a camera upside down set camera_roll: 3.1416',
            {'scale': seen},
        )
    off = 100.0 * (1.0 / seen - 1.0)
    side = 'long' if off > 0 else 'short'
    return Finding(
        'camera lens',
        'error' if abs(off) > 10.0 else 'warning',
        f'the focal length in camera_info is {abs(off):.0f} % too {side}',
        _ZOOM,
        {'scale': seen},
    )


def motion_findings(motion: Motion, slopes: Linear, room: Room | None) -> list[Finding]:
    """Judge scales, clocks, unit of the odometry and heading of the camera by the images."""
    found = [
        _small('pan scale', slopes.pan_scale, 0.05, 'check the gear of the pan'),
        _small('odom yaw', slopes.yaw_scale, 0.1, 'check the track width of the wheels'),
        _clock(JOINTS, slopes.pan_clock_s),
        _clock(ODOMETRY, slopes.odometry_clock_s),
    ]
    if motion.odometry is None:
        found = found[::2]
    more = _parallax(slopes, room)
    said = {finding.name for finding in more}
    return [*(finding for finding in found if finding.name not in said), *more]


def _small(name: str, error: Estimate, known: float, advice: str) -> Finding:
    values = {'scale': 1.0 + error.value, 'sigma': error.sigma}
    if error.sigma > known:
        return Finding(name, 'ok', 'not judged: it hardly moves')
    text = f'{1.0 + error.value:.3f} of the images (sigma {error.sigma:.3f})'
    warn = PAN_WARN if name == 'pan scale' else YAW_WARN
    if error.beyond(warn, known):
        return Finding(name, 'warning', text, advice, values)
    return Finding(name, 'ok', text, '', values)


PAN_WARN, YAW_WARN = 0.03, 0.15


def _clock(stream: str, late: Estimate) -> Finding:
    if late.sigma > 0.1:
        return Finding(f'{stream} clock', 'ok', 'not judged by motion: it hardly moves')
    text = f'{1e3 * late.value:+.0f} ms against the images (sigma {1e3 * late.sigma:.0f} ms)'
    values = {'late_s': late.value, 'sigma_s': late.sigma}
    if late.beyond(0.05, 0.1):
        return Finding(
            f'{stream} clock', 'warning', text, 'stamp at the time of measurement', values
        )
    return Finding(f'{stream} clock', 'ok', text, '', values)


def _parallax(slopes: Linear, room: Room | None) -> list[Finding]:
    """Judge unit and direction of the odometry and heading of the camera by parallax."""
    size = float(np.hypot(slopes.nearness.value, slopes.sideways.value))
    sigma = max(slopes.nearness.sigma, slopes.sideways.sigma)
    expected = nearness_of_room(room) if room is not None else float('nan')
    low, high = (_FAR, _NEAR) if np.isnan(expected) else (expected / _OF_ROOM, expected * _OF_ROOM)
    usual = 0.3 if np.isnan(expected) else expected
    if not np.isfinite(sigma) or size < 1e-9:
        return []
    found = []
    values = {'nearness_per_m': size, 'sigma_per_m': sigma}
    if size + 4.0 * sigma < low:
        unit = unit_of(usual / size)
        like = f', as if in {unit}' if unit else ''
        found.append(
            Finding(
                'odom unit',
                'error',
                f'moves {usual / size:.3g} times as far as the images show{like}',
                'publish odom in metres',
                values,
            )
        )
    elif size - 4.0 * sigma > high:
        found.append(
            Finding(
                'odom unit',
                'error',
                f'moves {usual / size:.2g} times as far as the images show',
                'publish odom in metres; check the radius of the wheels',
                values,
            )
        )
    elif size > 4.0 * sigma:
        found.append(
            Finding('odom unit', 'ok', f'what is seen is {1.0 / size:.1f} m away', '', values)
        )
    if size < 6.0 * sigma:
        return found
    turned, spread = slopes.heading_rad
    values = {'heading_rad': turned, 'sigma_rad': spread}
    text = f'looks {abs(np.degrees(turned)):.0f} deg to the {"left" if turned > 0 else "right"}'
    text += f' of where pan and mount say (sigma {np.degrees(spread):.0f} deg)'
    if abs(turned) - 4.0 * spread > np.radians(140.0):
        advice = 'odometry drives backwards, or pan_axis rpy is half a turn off'
        found.append(Finding('camera heading', 'error', text, advice, values))
    elif abs(turned) - 3.0 * spread > _HEADING_WARN_RAD and slopes.straight > ALIKE:
        text = f'curves by {np.degrees(-slopes.curved_rad_m):.0f} deg/m against the images'
        values = {'curve_rad_m': -slopes.curved_rad_m}
        found.append(Finding('odom yaw', 'warning', text, _WHEELS, values))
    elif abs(turned) - 3.0 * spread > HEADING_ERROR_RAD:
        advice = 'fix pan_axis rpy (radians) in robot.yaml, or the zero of the pan'
        found.append(Finding('camera heading', 'error', text, advice, values))
    elif abs(turned) - 3.0 * spread > _HEADING_WARN_RAD:
        advice = 'check pan_axis rpy (radians) in robot.yaml and the zero of the pan'
        if slopes.straight > -ALIKE:
            text += ' (or odom yaw curves: undecided)'
        found.append(Finding('camera heading', 'warning', text, advice, values))
    else:
        found.append(Finding('camera heading', 'ok', text, '', values))
    return found
