"""Findings of motion in words: a fault, its magnitude, and the remedy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from landmark_nav.diagnosis.camera_errors import CameraError
from landmark_nav.diagnosis.causes import Cause, CLOCKS, Verdict
from landmark_nav.diagnosis.findings import Finding, Level
from landmark_nav.diagnosis.motion import ALIKE, Estimate, IMAGES, JOINTS, Linear, Motion, ODOMETRY
from landmark_nav.diagnosis.odometry import nearness_of_room, unit_of
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
# Greatest turn between two images of a stream that stays where it is.
_STAYS_RAD = 0.01
# Offset beyond which one clock is wall time and the other simulated time.
_WALL_TIME_S = 1e6

_WHEELS = 'calibrate the radii of the wheels, on a straight line'

_OTHERS = {IMAGES: 'joint_states and odom', JOINTS: 'images', ODOMETRY: 'images'}


def is_corrected(late: Estimate) -> bool:
    """Whether an offset is small enough to be corrected, or may be."""
    leeway_s = 3.0 * late.sigma if np.isfinite(late.sigma) else 0.0
    return abs(late.value) <= CORRECTED_S + leeway_s


def clock_finding(stream: str, late_s: float, how: str = '', *, corrected: bool) -> Finding:
    """Return the finding of a clock offset of a stream."""
    side = 'late' if late_s > 0.0 else 'early'
    against = _OTHERS[stream]
    text = f'stamped {seconds_text(abs(late_s))} {side} against {against}{how}'
    values = {'late_s': late_s}
    if corrected:
        advice = 'corrected here; on the robot stamp at the time of measurement'
        if stream == IMAGES and late_s > 0.0:
            both = f'{late_s:+.3f} to image_delay, {-late_s:+.3f} to joint_delay'
            advice = f'corrected here; in robot.yaml add {both}'
        # `evaluate` reports the joint delay more accurately in a separate line.
        by_map = stream == JOINTS
        if by_map:
            advice = f'corrected here; in robot.yaml add {late_s:+.3f} to joint_delay'
        return Finding(f'{stream} clock', 'warning', text, advice, values, by_map)
    advice = (
        'wall time beside simulated time: set use_sim_time alike everywhere'
        if abs(late_s) > _WALL_TIME_S
        else 'stamp all streams by one clock (chrony), at the time of measurement'
    )
    return Finding(f'{stream} clock', 'error', text, advice, values)


def step_finding(stream: str, step_s: float, at_s: float) -> Finding:
    """Build the finding of the clock of a stream that was set."""
    text = f'steps {"ahead" if step_s > 0.0 else "back"} by {seconds_text(abs(step_s))}'
    text += f' at {at_s:.1f} s'
    level: Level = 'error' if abs(step_s) > CORRECTED_S else 'warning'
    advice = 'discipline the clock of its host before driving (chrony)'
    return Finding(f'{stream} clock', level, text, advice, {'step_s': step_s, 'at_s': at_s})


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
        motion, noise_rad = cause.motion, cause.left.noise_rad
        for stream, what in (
            (JOINTS, 'the pan does not move'),
            (ODOMETRY, 'its heading does not change'),
        ):
            given = stream == JOINTS or motion.odometry is not None
            if given and np.abs(motion.turned(stream)).max(initial=0.0) < _STAYS_RAD:
                text = f'{what} while the images turn'
                advice = 'see whether its driver hangs; if it does stand, look at the others'
                return [Finding(f'{stream} values', 'warning', text, advice)]
        text = 'no single fault explains how the images turn '
        text += f'({np.degrees(noise_rad):.1f} deg are left)'
        advice = 'undecided: look at joint_states, odom and images; more than one may be off'
        return [Finding('image motion', 'warning', text, advice, {'noise_rad': noise_rad})]
    clocks = [
        clock_finding(stream, late.value, corrected=is_corrected(late))
        for stream, late in reversed(cause.late.items())
    ]
    *others, finding = clocks or [_named(cause)]
    if judged.rivals:
        kinds = {(c.stream, 'clock' if c.kind in CLOCKS else c.kind) for c in judged.rivals}
        also = ', '.join(sorted(map(' '.join, kinds)))
        finding = replace(finding, measured=f'{finding.measured} (or {also}: undecided)')
        if cause.stream == JOINTS and cause.value < 0.0 and (IMAGES, 'clock') in kinds:
            late = f'; if images are late, also {-cause.value:+.3f} to image_delay'
            finding = replace(finding, advice=finding.advice + late)
    return [*others, finding]


# Least value of a lens or mount error that is of level error: radians, or a share of the focal
# length.
_CAMERA_OFF = 0.14
_ZOOM = 'calibrate the camera at the size and zoom that are published'
_SQUARE = 'calibrate again: pixels are square, if the driver does not stretch images'


def camera_finding(error: CameraError) -> Finding:
    """Return the finding of an error of lens or mount."""
    value, camera, mount = error.value, error.setup.camera, error.setup.mount
    degrees = abs(np.degrees(value))
    share, more = 100.0 * abs(np.expm1(-value)), value > 0.0
    rpy = ', '.join(f'{angle:.3f}' for angle in mount.axis_rpy)
    fix = f'set pan_axis rpy: [{rpy}] in robot.yaml'
    too_long = f'in camera_info is {share:.0f} % too {"short" if more else "long"}'
    off, cropped = f'of pan_axis is off by {degrees:.0f} deg', 'images that are cropped need'
    name, text, advice = {
        'focal length': ('camera lens', f'the focal length {too_long}', _ZOOM),
        'fx': ('camera lens', f'fx {too_long}', _SQUARE),
        'fy': ('camera lens', f'fy {too_long}', _SQUARE),
        'size': (
            'camera lens',
            f'its K is of images {share:.0f} % {"smaller" if more else "larger"}',
            'publish K of the size that is published, or binning and roi with K of the full image',
        ),
        'tilt': (
            'camera tilt',
            f'looks {degrees:.0f} deg {"higher" if more else "lower"} than mount and tilt say',
            'fix the zero of the tilt, or pan_axis rpy (pitch) in robot.yaml',
        ),
        'axis pitch': ('camera mount', f'the pitch {off}', fix),
        'axis roll': ('camera mount', f'the roll {off}', fix),
        'roll': (
            'camera roll',
            f'images are turned by {np.degrees(value):.0f} deg',
            f'set camera_roll: {mount.camera_roll_rad:.4f} in robot.yaml, or turn them',
        ),
        'cx': (
            'camera lens',
            f'the principal point is {abs(value) * camera.fx:.0f} px farther '
            f'{"right" if more else "left"} than cx in camera_info',
            f'calibrate again; {cropped} cx of the part that is left',
        ),
        'cy': (
            'camera lens',
            f'the principal point is {abs(value) * camera.fy:.0f} px farther '
            f'{"down" if more else "up"} than cy in camera_info',
            f'calibrate again; {cropped} cy of the part that is left',
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


_LEVER = (
    'camera mount',
    'the pan axis is {size:.1f} m {side} of where robot.yaml has it',
    'measure pan_axis xyz: metres ahead, to the left and up of base_link',
)
# Kind of a cause -> name of its finding, what was measured, remedy, and key of its value.
_OTHER_CAUSES = {
    'joint': (
        'joint names',
        'joint {joint} turns as the camera does, that of robot.yaml does not',
        'set pan_joint: {joint} in robot.yaml',
        'pan_joint',
    ),
    'twist': (
        'odom yaw',
        'its pose does not turn as the camera does, its twist does',
        'publish the pose that the twist sums up to',
        '',
    ),
    'speed': (
        'pan unit',
        'summed up, the pan is what the images turn by: it holds speeds, not angles',
        'publish angles as position in joint_states',
        '',
    ),
    'filter': (
        'pan filter',
        'the pan follows the images as behind a filter of {size:.2f} s',
        'publish what the encoder measures, not what a controller or a smoother makes of it',
        'filter_s',
    ),
    'heading': (
        'pan frame',
        'the pan has the yaw of odom in it: it is an angle against the room',
        'publish the angle of the joint, against the robot',
        '',
    ),
    'bias': (
        'odom yaw',
        'drifts by {degrees:.1f} deg/s against the images',
        'calibrate the gyro while the robot stands',
        'bias_rad_s',
    ),
    'curve': (
        'odom yaw',
        'curves by {degrees:.0f} deg/m against the images',
        _WHEELS,
        'curve_rad_m',
    ),
    'upside down': (
        'camera mount',
        'the images show the camera the other way up than robot.yaml: upside down, or not',
        'fix pan_axis rpy (a unit that hangs: [3.1416, 0, 0]) or camera_roll in robot.yaml',
        '',
    ),
    'offset': (
        'camera mount',
        'the optical centre is {size:.2f} m {side} of where robot.yaml has it',
        'measure optical_center_offset from the pan axis, in metres',
        'offset_m',
    ),
    'ahead': (*_LEVER, 'ahead_m'),
    'left': (*_LEVER, 'left_m'),
}


def _named(cause: Cause) -> Finding:
    stream, value = cause.stream, cause.value
    if cause.kind == 'drift':
        share, off_s = 100.0 * abs(value), abs(cause.offset_s)
        text = f'{share:.1f} %' if share < 1e3 else f'{1.0 + value:.4g} times'
        text = f'runs {text} {"fast" if value > 0.0 else "slow"} against {_OTHERS[stream]}'
        text += f', {seconds_text(off_s)} off at the start' if off_s > 1.0 else ''
        advice = 'its stamps drift: stamp by the clock of the host, disciplined by chrony'
        values = {'drift': value, 'offset_s': cause.offset_s}
        return Finding(f'{stream} clock', 'error', text, advice, values)
    if cause.kind == 'step':
        return step_finding(stream, value, cause.offset_s)
    if cause.kind not in _OTHER_CAUSES:
        return _scale_finding(stream, value)
    name, text, advice, key = _OTHER_CAUSES[cause.kind]
    side, other = ('to the left', 'to the right') if cause.kind == 'left' else ('ahead', 'behind')
    fields = {
        'joint': cause.name,
        'size': abs(value),
        'degrees': np.degrees(-value),
        'side': side if value > 0.0 else other,
    }
    measured = -value if cause.kind in ('bias', 'curve') else value
    found: Any = cause.name if cause.kind == 'joint' else measured
    values = {key: found} if key else {}
    return Finding(name, 'error', text.format(**fields), advice.format(**fields), values)


def _scale_finding(stream: str, factor: float) -> Finding:
    """Return the finding of a stream that has to be multiplied by `factor` to fit the images."""
    times = 1.0 / factor if abs(factor) > 1e-9 else np.inf
    off, far = abs(times - 1.0), f'{times:.3g} times as far as the images turn'
    level: Level = 'error'
    if stream == JOINTS:
        name, text = 'pan scale', f'the pan moves {far}'
        if abs(factor + 1.0) < 0.15:
            name, text = 'pan sign', 'the images turn against the pan: its sign is reversed'
            advice = 'negate the pan, unmirror images, or set camera_roll: 3.1416 if upside down'
        elif abs(np.degrees(abs(factor)) - 1.0) < 0.15:
            text, advice = f'{text}: degrees', 'publish joint_states in radians'
        elif abs(factor) < 1e-4:
            text = 'the images do not turn with the pan'
            advice = 'check pan_joint in robot.yaml and the driver of the joints'
        else:
            advice = (
                'check gear or unit of the pan, the focal length in camera_info, and '
                'optical_center_offset'
            )
            level = 'error' if off > _PAN_OFF else 'warning'
        return Finding(name, level, text, advice, {'scale': times})
    if stream == ODOMETRY:
        text = f'turns {far}'
        if abs(factor + 1.0) < 0.35:
            text = 'the images turn against its yaw: the sign of the yaw is reversed'
            advice = 'yaw is counter-clockwise: check the sides and signs of the wheels'
        elif not 0.05 <= abs(factor) <= 20.0:
            advice = 'the yaw does not follow the robot: publish the integrated heading in radians'
        else:
            advice = 'check the track width of the wheels, and the unit of the heading'
            level = 'error' if off > _YAW_OFF else 'warning'
        return Finding('odom yaw', level, text, advice, {'scale': times})
    if abs(factor + 1.0) < 0.2:
        text = 'turn against both pan and odometry: mirrored or upside down'
        advice = 'do not flip images; for a camera upside down set camera_roll: 3.1416'
        return Finding('images sign', level, text, advice, {'scale': factor})
    side = 'long' if times > 1.0 else 'short'
    text = f'the focal length in camera_info is {100.0 * off:.0f} % too {side}'
    level = 'error' if off > 0.1 else 'warning'
    return Finding('camera lens', level, text, _ZOOM, {'scale': factor})


def motion_findings(motion: Motion, slopes: Linear, room: Room | None) -> list[Finding]:
    """Judge scales, clocks, unit of the odometry and heading of the camera by the images."""
    gear, track = 'check the gear of the pan', 'check the track width of the wheels'
    scales = [_scale('pan scale', slopes.pan_scale, 0.05, 0.03, gear)]
    clocks = [_clock(JOINTS, slopes.pan_clock_s)]
    if motion.odometry is not None:
        scales.append(_scale('odom yaw', slopes.yaw_scale, 0.1, 0.15, track))
        clocks.append(_clock(ODOMETRY, slopes.odometry_clock_s))
    more = _unit(slopes, room) + _heading(slopes)
    said = {finding.name for finding in more}
    return [*(finding for finding in scales + clocks if finding.name not in said), *more]


def _scale(name: str, error: Estimate, known: float, warn: float, advice: str) -> Finding:
    """Return the finding of a relative error, judged if its sigma is less than `known`."""
    if error.sigma > known:
        return Finding(name, 'ok', 'not judged: it hardly moves')
    text = f'{1.0 + error.value:.3f} of the images (sigma {error.sigma:.3f})'
    values = {'scale': 1.0 + error.value, 'sigma': error.sigma}
    wrong = error.beyond(warn, known)
    return Finding(name, 'warning' if wrong else 'ok', text, advice if wrong else '', values)


def _clock(stream: str, late: Estimate) -> Finding:
    if late.sigma > 0.1:
        return Finding(f'{stream} clock', 'ok', 'not judged by motion: it hardly moves')
    text = f'{1e3 * late.value:+.0f} ms against the images (sigma {1e3 * late.sigma:.0f} ms)'
    values = {'late_s': late.value, 'sigma_s': late.sigma}
    wrong, advice = late.beyond(0.05, 0.1), 'stamp at the time of measurement'
    level: Level = 'warning' if wrong else 'ok'
    return Finding(f'{stream} clock', level, text, advice if wrong else '', values)


def _unit(slopes: Linear, room: Room | None) -> list[Finding]:
    """Judge the unit of the odometry by parallax."""
    size, sigma = slopes.parallax
    if not np.isfinite(sigma) or size < 1e-9:
        return []
    usual, low, high = 0.3, _FAR, _NEAR
    if room is not None and np.isfinite(expected := nearness_of_room(room)):
        usual, low, high = expected, expected / _OF_ROOM, expected * _OF_ROOM
    values = {'nearness_per_m': size, 'sigma_per_m': sigma}
    if size + 4.0 * sigma < low or size - 4.0 * sigma > high:
        unit = unit_of(usual / size)
        like = f', as if in {unit}' if unit else ''
        text = f'moves {usual / size:.3g} times as far as the images show{like}'
        advice = 'publish odom in metres' + ('' if unit else '; check the radius of the wheels')
        return [Finding('odom unit', 'error', text, advice, values)]
    if size > 4.0 * sigma:
        return [Finding('odom unit', 'ok', f'what is seen is {1.0 / size:.1f} m away', '', values)]
    return []


def _heading(slopes: Linear) -> list[Finding]:
    """Judge the direction of the odometry and the heading of the camera by parallax."""
    size, sigma = slopes.parallax
    if not np.isfinite(sigma) or size < max(6.0 * sigma, 1e-9):
        return []
    turned, spread = slopes.heading_rad
    values = {'heading_rad': turned, 'sigma_rad': spread}
    text = f'looks {abs(np.degrees(turned)):.0f} deg to the {"left" if turned > 0 else "right"}'
    text += f' of where pan and mount say (sigma {np.degrees(spread):.0f} deg)'
    off_rad = abs(turned) if abs(turned) > 3.0 * spread else 0.0
    level: Level = 'ok'
    name, advice = 'camera heading', ''
    if abs(turned) - 4.0 * spread > np.radians(140.0):
        level, advice = 'error', 'odometry drives backwards, or pan_axis rpy is half a turn off'
    elif off_rad > _HEADING_WARN_RAD and slopes.straight > ALIKE:
        name, level, advice = 'odom yaw', 'warning', _WHEELS
        text = f'curves by {np.degrees(-slopes.curved_rad_m):.0f} deg/m against the images'
        values = {'curve_rad_m': -slopes.curved_rad_m}
    elif off_rad > HEADING_ERROR_RAD:
        level, advice = 'error', 'fix pan_axis rpy (radians) in robot.yaml, or the zero of the pan'
    elif off_rad > _HEADING_WARN_RAD:
        level = 'warning'
        advice = 'check pan_axis rpy (radians) in robot.yaml and the zero of the pan'
        if slopes.straight > -ALIKE:
            text += ' (or odom yaw curves: undecided)'
    return [Finding(name, level, text, advice, values)]
