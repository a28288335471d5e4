"""Results of checks, one line each, for people and programs; what they can be, in one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from string import Formatter
from typing import Any, Literal

import numpy as np

from landmark_nav.errors import one_line

Level = Literal['ok', 'warning', 'error']


@dataclass(frozen=True)
class Finding:
    """
    The result of one check; ``error`` if localization or learning cannot handle the fault.

    `measured` is for people, with units; `values` are the same for programs, with units in their
    names, such as ``offset_s``. `advice` is empty if the check passed. `when_read`: the readers of
    the bag report it as well, message by message.
    """

    name: str
    level: Level
    measured: str
    advice: str = ''
    values: dict[str, Any] = field(default_factory=dict)
    when_read: bool = False

    def __post_init__(self) -> None:
        """Make both texts one line: names in messages may hold any characters."""
        object.__setattr__(self, 'measured', one_line(self.measured))
        object.__setattr__(self, 'advice', one_line(self.advice))

    def line(self) -> str:
        """Return name, measurement and advice in one line."""
        return f'{self.name}: {self.measured}' + (f': {self.advice}' if self.advice else '')

    def report(self) -> dict[str, Any]:
        """Return the entry of ``check --json``."""
        return {k: v for k, v in vars(self).items() if k != 'when_read'}


@dataclass(frozen=True)
class Delays:
    """
    Delays of the stamps of streams, s, beyond those of ``robot.yaml``, that readers subtract.

    `pan_sigma_s` is the sigma of the delay between images and joints.
    """

    images_s: float = 0.0
    joints_s: float = 0.0
    odometry_s: float = 0.0
    pan_sigma_s: float = 0.0


@dataclass(frozen=True)
class Diagnosis:
    """Findings, and the delays that can be corrected."""

    findings: tuple[Finding, ...]
    delays: Delays = Delays()

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that prevent localization or learning."""
        return tuple(finding for finding in self.findings if finding.level == 'error')

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Findings that reduce, or may reduce, the accuracy."""
        return tuple(finding for finding in self.findings if finding.level == 'warning')

    @property
    def status(self) -> Level:
        """Level of the worst finding."""
        return 'error' if self.errors else 'warning' if self.warnings else 'ok'


def table(findings: Sequence[Finding]) -> list[str]:
    """Aligned lines: name, level and measurement; the advice is on a line below."""
    width = max((len(finding.name) for finding in findings), default=0)
    lines = []
    for finding in findings:
        lines.append(f'{finding.name:{width}}  {finding.level:7}  {finding.measured}')
        if finding.advice:
            lines.append(f'{"":{width}}           {finding.advice}')
    return lines


def seconds_text(seconds: float) -> str:
    """Format the size of a time for people."""
    size = abs(seconds)
    if size < 1.0:
        return f'{1e3 * size:.0f} ms'
    return f'{size:.2f} s' if size < 1e5 else f'{size:.6g} s'


_CONVERSIONS: dict[str | None, Callable[[Any], Any]] = {
    'd': lambda angle: abs(np.degrees(angle)),
    'D': np.degrees,
    'm': abs,
    'n': lambda value: -value,
    'p': lambda share: 100.0 * abs(share),
    't': seconds_text,
}


class _Words(Formatter):
    """
    Formatter with conversions of its own.

    They are size in degrees ``!d``, degrees ``!D``, size ``!m``, negative ``!n``, size in percent
    ``!p`` and a time ``!t``; ``{value:more|less}`` is a word by the sign.
    """

    def convert_field(self, value: Any, conversion: Any) -> Any:
        return _CONVERSIONS[conversion](value) if conversion else value

    def format_field(self, value: Any, format_spec: str) -> Any:
        more, divided, less = format_spec.partition('|')
        if divided:
            return more if value > 0.0 else less
        return super().format_field(value, format_spec)


_WORDS = _Words()
_REP_103 = 'publish x ahead, y to the left at yaw 0, yaw counter-clockwise (REP-103)'
_LATE = 'stamped {late_s!t} {late_s:late|early} against {1}{2}'
_TIMES = '{scale:.3g} times as far as the images turn'
_LENS = 'calibrate the camera at the size and zoom that are published'
_SQUARE = 'calibrate again: pixels are square, if the driver does not stretch images'
_TOO_LONG = 'in camera_info is {0} % too {value:short|long}'
_CENTRE = 'the principal point is {0} px farther'
_CROPPED = 'calibrate again; images that are cropped need the cx, cy of the part that is left'
_OFF = 'of pan_axis is off by {value!d:.0f} deg'
_AXIS = 'set pan_axis rpy: [{0}] in robot.yaml'
_GIVEN = 'of where robot.yaml has it'
_XYZ = 'measure pan_axis xyz: metres ahead, to the left and up of base_link'
_HEADING = (
    'looks {heading_rad!d:.0f} deg to the {heading_rad:left|right} of where pan and mount say '
    '(sigma {sigma_rad!d:.0f} deg)'
)
_ZERO = 'check pan_axis rpy (radians) in robot.yaml and the zero of the pan'
_TWIST = 'pose {1} {ratio:.3g} times its twist'


# fmt: off
class Code(Enum):
    """
    Name of the check, usual level, what was measured, and what to do.

    Texts take the values of the finding by name and other words by number; {0} is the stream where
    the check is one of several.
    """

    # Streams, each by itself.
    VALUES = '{0} values', 'warning', '{refused} of {messages} messages cannot be used', '{1}'
    FEW = '{0} rate', 'warning', '{messages} messages', 'record more'
    ZEROS = ('{0} stamps', 'warning', '{zeros} of {messages} are 0: the time of recording is used',
             '{1} must stamp {0} (header.stamp)')
    NANOSECONDS = ('{0} stamps', 'error', 'nanosec is {most_ns} at most: it counts {1}',
                   'put nanoseconds into header.stamp.nanosec')
    RATE = ('{0} rate', 'ok', '{rate_hz:.1f} Hz, {messages} messages',
            'publish {0} at {1:g} Hz or more')
    GAP = ('{0} gaps', 'warning', 'none for {longest_s:.2f} s at {at_s:.1f} s',
           'localization takes {1:g} s: look at {2} and the recorder')
    SET_FORWARD = ('{0} gaps', 'warning', 'stamps go forward by {longest_s:.4g} s at {at_s:.1f} '
                   's, recording does not', 'its clock was set: set it before nodes start (NTP)')
    JITTER = ('{0} jitter', 'warning', 'stamps jitter by {stamps_s!t}, arrival by {arrival_s!t}',
              '{1} must stamp {0} at the time of measurement')
    ORDER = ('{0} order', 'warning', '{duplicates} stamps come twice, {backward} out of order',
             'each message needs the time of its measurement')
    SET_BACK = ('{0} order', 'warning', 'stamps go back {backward} times, by {backward_s:.1f} s '
                'at most', 'its clock was set back, or two sources send: one clock, one source')
    RECORDING = ('recording order', 'error', '{0} in a wrong order: by even stamps, times of '
                 'recording are off by {off_s:.1f} s', 'record with one recorder, or convert with '
                 'the stamps as times of recording')
    SOURCES = ('{0} sources', 'error', 'two sources in turns: {1:.0f} Hz, and {2:.0f} Hz that {3}',
               'two nodes publish {4}: stop one or remap it (ros2 topic info -v)')
    READING = 'reading', 'warning', '{0}'
    HELD = ('{0} rate', 'warning', 'values change {changes_hz:.1f} times a second, messages come '
            '{messages_hz:.0f} times', 'each is repeated: publish it once, stamped when measured')
    RESOLUTION = ('{0} resolution', 'error', 'comes in steps of {step_rad!d:.2g} deg',
                  'publish what the encoder measures: no rounding, no few set points')

    # Images.
    UNDECODED = 'images encoding', 'warning', '{failed} of {tried} cannot be used', '{0}'
    ENCODING = 'images encoding', 'ok', '{0}', 'one camera must publish one size and encoding'
    NO_LENS = 'camera lens', 'error', '{0}'
    LENS = ('camera lens', 'ok', '{field_of_view_deg:.0f} deg wide, f {fx_px:.0f} px, {0}',
            'calibrate the camera: no lens that localization takes sees so much')
    NOT_SQUARE = 'camera lens', 'warning', 'fy is {0:.0f} px beside fx of {fx_px:.0f} px', _SQUARE
    ZOOM = ('camera zoom', 'warning', 'the focal length in camera_info changes by {0:.0f} %',
            'publish one calibration if the lens neither zooms nor focuses')
    BLANK = ('images content', 'warning', '{blank} of {tried} have hardly any contrast: dark, '
             'white or covered', 'look at exposure, lens cap and light')
    BLURRED = ('images sharpness', 'warning', 'out of focus: fine details have {sharpness!p:.1f} '
               '% of the contrast of coarse ones', 'focus and clean the lens; expose shorter')
    COVERED = ('images cover', 'warning', '{share!p:.0f} % of each image stay the same, most on '
               'the side {0}', 'free the lens; no part of the robot, text or frame belongs there')
    FLICKERING = ('images exposure', 'warning', 'the brightness changes by a factor of '
                  '{factor:.1f} from image to image', 'fix exposure, or bind it to the mains')
    ALTERNATING = ('images content', 'error', '{odd} of {images} are like the one before the '
                   'last, not like the last', 'two cameras come in turns: stop one, or remap it')
    STRANGE = ('images content', 'warning', '{strange} of {pairs} show other things than the one '
               'before', 'is there a second camera, do images come in order?')
    STILL = ('images motion', 'error', 'images stay the same while joint_states turn',
             'the camera repeats an image, or the pan does not move: look at both drivers')
    REPEATED = ('images motion', 'error', '{repeated} of {turning} images repeat the one before '
                'while the camera turns', 'its driver stamps images twice: publish each once')
    REPEATED_AT_TIMES = ('images motion', 'warning', '{repeated} of {turning} images repeat the '
                         'one before and are left out', 'its driver hangs at times')

    # Odometry by its own values.
    NO_ODOMETRY = 'odom', 'error', 'there is no odom', 'record odom'
    SPEED = ('odom speed', 'ok', '{speed_m_s:.2f} m/s (90 %)',
             'publish odom in metres; by its speed it looks like centimetres or millimetres')
    TWIST = ('odom twist, {0}', 'warning', _TWIST,
             'pose and twist contradict each other: look at scale and child_frame_id')
    TWIST_OPPOSITE = ('odom twist, {0}', 'warning', _TWIST,
                      'pose and twist have opposite signs: publish both by REP-103')
    TWIST_ALONE = ('odom twist, {0}', 'warning', _TWIST,
                   'the pose stands while the twist moves: publish the integrated pose')
    TWIST_UNIT = ('odom twist, {0}', 'warning', _TWIST,
                  'the {2} looks like {3}: publish metres and radians')
    JUMPS = ('odom jumps', 'warning', 'jumps by {metres:.2f} m and {0!d:.0f} deg at {1:.1f} s '
             '({jumps} in all)', 'publish odom of the wheels alone, without resets by a map')
    PATH_ASIDE = 'odom path', 'error', 'leads {aside_rad!d:.0f} deg aside of the yaw', _REP_103
    PATH_MIRRORED = 'odom path', 'error', 'is mirrored: {0} beside the yaw', _REP_103
    FRAMES = 'frames', 'ok', 'odom: {0}; images: {1}'
    FRAMES_SEVERAL = ('frames', 'warning', 'odom: {0}; images: {1}',
                      'odom names several frames: two nodes may publish it')
    FRAMES_OTHER = ('frames', 'warning', 'odom: {0}; images: {1}',
                    'odom should be about {2} (base_frame in robot.yaml)')

    # Lens and mount by tracked points; {0} is a number of the correction.
    FOCAL_LENGTH = 'camera lens', 'error', f'the focal length {_TOO_LONG}', _LENS
    FX = 'camera lens', 'error', f'fx {_TOO_LONG}', _SQUARE
    FY = 'camera lens', 'error', f'fy {_TOO_LONG}', _SQUARE
    SIZE = ('camera lens', 'error', 'its K is of images {0} % {value:smaller|larger}',
            'publish K of the size that is published, or binning and roi with K of the full image')
    TILT = ('camera tilt', 'error', 'looks {value!d:.0f} deg {value:higher|lower} than mount and '
            'tilt say', 'fix the zero of the tilt, or pan_axis rpy (pitch) in robot.yaml')
    AXIS_PITCH = 'camera mount', 'error', f'the pitch {_OFF}', _AXIS
    AXIS_ROLL = 'camera mount', 'error', f'the roll {_OFF}', _AXIS
    ROLL = ('camera roll', 'error', 'images are turned by {value!D:.0f} deg',
            'set camera_roll: {0} in robot.yaml, or turn them')
    CX = 'camera lens', 'error', f'{_CENTRE} {{value:right|left}} than cx in camera_info', _CROPPED
    CY = 'camera lens', 'error', f'{_CENTRE} {{value:down|up}} than cy in camera_info', _CROPPED
    DISTORTION = ('camera lens', 'error', 'its distortion is not that in camera_info: k1 is off '
                  'by {value!m:.2f}', 'calibrate this camera, and publish d with raw images')

    # Clocks; {0} is the stream, {1} what it is compared with, {2} how.
    LATE_IMAGES = ('{0} clock', 'warning', _LATE, 'corrected here; in robot.yaml add '
                   '{late_s:+.3f} to image_delay, {late_s!n:+.3f} to joint_delay')
    LATE_JOINTS = ('{0} clock', 'warning', _LATE,
                   'corrected here; in robot.yaml add {late_s:+.3f} to joint_delay')
    LATE_OTHER = ('{0} clock', 'warning', _LATE,
                  'corrected here; on the robot stamp at the time of measurement')
    CLOCK = ('{0} clock', 'error', _LATE,
             'stamp all streams by one clock (chrony), at the time of measurement')
    WALL_TIME = ('{0} clock', 'error', _LATE,
                 'wall time beside simulated time: set use_sim_time alike everywhere')
    STEP = ('{0} clock', 'error', 'steps {step_s:ahead|back} by {step_s!t} at {at_s:.1f} s',
            'discipline the clock of its host before driving (chrony)')
    DRIFT = ('{0} clock', 'error', 'runs {2} {drift:fast|slow} against {1}{3}',
             'its stamps drift: stamp by the clock of the host, disciplined by chrony')
    TRUTH_CLOCK = ('ground_truth clock', 'warning', 'stamped {late_s!t} {late_s:late|early} '
                   'against odom', 'it measures errors: stamp it by the clock of the robot')
    CLOCK_MEASURED = ('{0} clock', 'ok', '{1:+.0f} ms against the images (sigma {2:.0f} ms)',
                      'stamp at the time of measurement')
    CLOCK_UNKNOWN = '{0} clock', 'ok', 'not judged by motion: it hardly moves'

    # Turns by joints and odometry against those of the images.
    JOINT_NAMES = 'joint names', 'ok', '{0}'
    NO_JOINT = 'joint names', 'error', '{0}'
    OTHER_NAMES = ('joint names', 'error', 'there are {0}',
                   'set pan_joint in robot.yaml to what turns the camera, not {1}')
    OTHER_JOINT = ('joint names', 'error', '{pan_joint} turns as the camera does, the joint of '
                   'robot.yaml does not', 'set pan_joint: {pan_joint} in robot.yaml')
    SCALE = '{0}', 'ok', '{scale:.3f} of the images (sigma {sigma:.3f})', 'check the {1}'
    SCALE_UNKNOWN = '{0}', 'ok', 'not judged: it hardly moves'
    PAN_SIGN = ('pan sign', 'error', 'the images turn against the pan: its sign is reversed',
                'negate the pan, unmirror images, or set camera_roll: 3.1416 if upside down')
    PAN_DEGREES = ('pan scale', 'error', f'the pan moves {_TIMES}: degrees',
                   'publish joint_states in radians')
    PAN_ALONE = ('pan scale', 'error', 'the images do not turn with the pan',
                 'check pan_joint in robot.yaml and the driver of the joints')
    PAN_SCALE = ('pan scale', 'error', f'the pan moves {_TIMES}', 'check gear or unit of the pan, '
                 'the focal length in camera_info, and optical_center_offset')
    PAN_SPEED = ('pan unit', 'error', 'the images turn by the sum of the pan: it holds speeds',
                 'publish angles as position in joint_states')
    PAN_FILTER = ('pan filter', 'error', 'the pan follows the images as behind a filter of '
                  '{filter_s!m:.2f} s', 'publish what the encoder measures, unsmoothed')
    PAN_FRAME = ('pan frame', 'error', 'the pan has the yaw of odom in it: it is against the room',
                 'publish the angle of the joint, against the robot')
    PAN_LIMIT = ('pan limit', 'error', 'the images turn on where the pan stays at {low_rad:.2f} '
                 'or {high_rad:.2f} rad', 'its driver cuts off: publish what the joint does')
    JUMP = ('{0} jumps', 'error', 'jumps by {jump_rad!D:.0f} deg at {at_s:.1f} s, the images '
            'do not', 'its zero is another one since: see why it slips or was set anew')
    FROZEN = ('{0} values', 'error', '{1} stays as it is in {pairs} pairs of images that turn, '
              'from {begin_s:.1f} to {end_s:.1f} s', 'its driver hangs, or it is at its limit')
    HANGS = ('{0} values', 'warning', '{1} while the images turn',
             'see whether its driver hangs; if it does stand, look at the others')
    YAW_SIGN = ('odom yaw', 'error', 'the images turn against its yaw: its sign is reversed',
                'yaw is counter-clockwise: check the sides and signs of the wheels')
    YAW_ALONE = ('odom yaw', 'error', f'turns {_TIMES}',
                 'the yaw does not follow the robot: publish the integrated heading in radians')
    YAW_SCALE = ('odom yaw', 'error', f'turns {_TIMES}',
                 'check the track width of the wheels, and the unit of the heading')
    YAW_TWIST = ('odom yaw', 'error', 'its pose does not turn as the camera does, its twist does',
                 'publish the pose that the twist sums up to')
    YAW_DRIFT = ('odom yaw', 'error', 'drifts by {bias_rad_s!D:.1f} deg/s against the images',
                 'calibrate the gyro while the robot stands')
    YAW_CURVE = ('odom yaw', 'error', 'curves by {curve_rad_m!D:.0f} deg/m against the images',
                 'calibrate the radii of the wheels, on a straight line')
    UNIT = ('odom unit', 'error', 'moves {0:.3g} times as far as the images show{1}',
            'publish odom in metres{2}')
    DISTANCE = 'odom unit', 'ok', 'what is seen is {0:.1f} m away'
    IMAGES_SIGN = ('images sign', 'error', 'against pan and odometry: mirrored or upside down',
                   'do not flip images; for a camera upside down set camera_roll: 3.1416')
    IMAGES_SCALE = ('camera lens', 'error', 'the focal length in camera_info is {0:.0f} % too {1}',
                    _LENS)
    UPSIDE_DOWN = ('camera mount', 'error', 'upside down in images or in robot.yaml, not in both',
                   'fix pan_axis rpy (hanging: [3.1416, 0, 0]) or camera_roll in robot.yaml')
    OFFSET = ('camera mount', 'error', f'the optical centre is {{offset_m!m:.2f}} m '
              f'{{offset_m:ahead|behind}} {_GIVEN}', 'measure optical_center_offset, in metres')
    AXIS_AHEAD = ('camera mount', 'error', f'the pan axis is {{ahead_m!m:.1f}} m '
                  f'{{ahead_m:ahead|behind}} {_GIVEN}', _XYZ)
    AXIS_LEFT = ('camera mount', 'error', f'the pan axis is {{left_m!m:.1f}} m to the '
                 f'{{left_m:left|right}} {_GIVEN}', _XYZ)
    BACKWARDS = ('camera heading', 'error', _HEADING,
                 'odometry drives backwards, or pan_axis rpy is half a turn off')
    HEADING = 'camera heading', 'ok', _HEADING, _ZERO
    HEADING_OR_CURVE = ('camera heading', 'warning',
                        f'{_HEADING} (or odom yaw curves: undecided)', _ZERO)
    FEW_PAIRS = 'image motion', 'ok', '{0} pairs of images show turns: too few to judge'
    UNDECIDED = ('image motion', 'warning', 'no single fault explains how the images turn '
                 '({noise_rad!d:.1f} deg are left)', 'undecided: more than one may be off')

    # Sweeps.
    PUSHED = ('sweep motion', 'error', 'at {at_s:.1f} s the images turn {turned_rad!d:.0f} deg '
              'farther {turned_rad:left|right} than the pan',
              'base turned, pan slipped, or people passed: sweep again, all standing still')
    PLACED = '{0}', 'ok', 'pan axis at ({1:.2f}, {2:.2f}) m, {3:.1f} deg (sigma {4:.0f} mm)'
    NOT_PLACED = '{0}', 'error', '{1}'

    @property
    def check(self) -> str:
        """Name of the check."""
        return str(self.value[0])

    def found(self, *words: Any, **values: Any) -> Finding:
        """Return the finding with these values and other words of its texts."""
        return self.at(self.value[1], *words, **values)

    def at(self, level: Level, /, *words: Any, **values: Any) -> Finding:
        """Return the finding at another level than the usual one."""
        check, _, measured, advice = (*self.value, '')[:4]
        texts = check, measured, '' if level == 'ok' else advice
        check, measured, advice = (_WORDS.vformat(text, words, values) for text in texts)
        return Finding(check, level, measured, advice, values, self in _WHEN_READ)
# fmt: on


# What the readers of a bag report as well.
_WHEN_READ = {
    *(Code.VALUES, Code.READING, Code.UNDECODED, Code.NO_LENS, Code.NO_JOINT, Code.LATE_JOINTS)
}
