"""Errors of whole streams, put into a recorded drive, and the cause that should be named."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
from drive_faults import rewritten
import message_changes as m
from message_changes import (
    CAMERA,
    content,
    driven,
    each_second,
    from_on,
    INFO,
    JOINTS,
    later,
    ODOMETRY,
    pictured,
    with_second,
)  # fmt: skip
import numpy as np

from landmark_nav.geometry.camera import PanTiltMount

DEGREES = 180.0 / np.pi


@dataclass(frozen=True)
class StreamError:
    """
    An error of a stream.

    Parameters
    ----------
    topics : tuple of str
        Whose messages `change` alters.
    names : str
        Start of the name of the finding that names the cause, a regular expression.
    finding : str
        What that finding says, a regular expression.
    recorded : bool
        Whether the recorder's clock is off with the stamps.
    robot : callable, optional
        What becomes of robot.yaml.
    """

    topics: tuple[str, ...]
    change: m.Change
    names: str
    finding: str = ''
    recorded: bool = False
    robot: Callable[[PanTiltMount], PanTiltMount] | None = None

    def write(self, source, path):
        """Write a drive, or sweeps, with this error in it."""
        return rewritten(source, path, self.topics, self.change, self.recorded)


odom, joints = partial(StreamError, (ODOMETRY,)), partial(StreamError, (JOINTS,))
images, info = partial(StreamError, (CAMERA,)), partial(StreamError, (INFO,))
both = partial(StreamError, (CAMERA, INFO))
joints_and_odom = partial(StreamError, (JOINTS, ODOMETRY))
trajectory = partial(StreamError, ('sweep/trajectory',))
swept = partial(StreamError, ('sweep/image/compressed',))


def mount(names, finding, **values):
    """Error of robot.yaml; a function is applied to the right value."""

    def changed(right):
        wrong = {k: v(getattr(right, k)) if callable(v) else v for k, v in values.items()}
        return replace(right, **wrong)

    return StreamError((), m.same, names, finding, robot=changed)


# fmt: off
def of_drives():
    """
    Errors of drives by list, in the order in which the lists were written down.

    Users reported the first. The others were written down before any try, each when what the one
    before had missed was fixed. Changes remember messages: use each for one drive.
    """
    return {
        'reported': {
            'odom +1 s': odom(later(1.0), 'odom clock', '(1.0. s|0.9. s|9.. ms)'),
            'odom +5 s': odom(later(5.0), 'odom clock', '(5.0|4.9)'),
            'odom -60 s': odom(later(-60.0), 'odom clock', '(60.0|59.9)'),
            'odom -4990 s': odom(later(-4990.0), 'odom clock', '(4990|4989.9)'),
            'odom +1 s, recorded so': odom(
                later(1.0), 'odom clock', '(1.0. s|0.9. s|9.. ms)', True),
            'odom +5 s, recorded so': odom(later(5.0), 'odom clock', '(5.0|4.9)', True),
            'odom -60 s, recorded so': odom(later(-60.0), 'odom clock', '(60.0|59.9)', True),
            'odom clock 5 % fast': odom(m.drifting(0.05), 'odom clock', '% fast'),
            'odom +1.7e9 s': odom(later(1.7e9), 'odom clock', '1.7e.09'),
            'odom stamps all 0': odom(m.stamps(lambda _: 0), 'odom stamps', '0'),
            'joint_states +5 s': joints(later(5.0), 'joint_states clock', '(5.0|4.9)'),
            'pan reversed': joints(m.times(-1.0), 'pan sign', 'reversed'),
            'pan in degrees': joints(m.times(DEGREES), 'pan scale', 'degrees'),
            'yaw reversed': odom(driven(yaw=-1.0), 'odom yaw', 'reversed'),
            'yaw reversed, mirrored path': odom(driven(y=-1.0, yaw=-1.0), 'odom yaw', 'reversed'),
            'odom x and y exchanged': odom(m.exchanged, 'odom', 'x and y|mirrored'),
            'odom in cm': odom(driven(100.0, 100.0), 'odom', 'centimetres'),
            'zeros between joint_states': joints(
                with_second(5, m.joints(np.zeros_like)), 'joint_states sources', 'two sources'),
            'images 100 ms late': images(later(0.1), 'images clock', 'late'),
            'pan_joint of another name': mount(
                'joint names', 'pan_joint', pan_joint='head_pan_joint'),
            'rpy of 5 degrees as radians': mount(
                'camera heading', 'radians', axis_rpy=(0.0, 0.0, 5.0)),
            'truth +30 s': StreamError(
                ('ground_truth/odom',), later(30.0), 'ground_truth clock', '(30.0|29.9)'),
        },
        'others': {
            'images mirrored': images(pictured(lambda i: i[:, ::-1]), 'images sign'),
            'images upside down': images(pictured(lambda i: i[::-1, ::-1]), 'images sign'),
            'focal length 20 % long': info(m.lens(1.2, 1.2), 'camera lens', 'long'),
            'zero of the pan off by 0.4 rad': joints(m.added(0.4), 'camera heading'),
            'odom drives backwards': odom(driven(-1.0, -1.0), 'camera heading', 'backwards'),
            'odom in mm': odom(driven(1000.0, 1000.0), 'odom', 'millimetres'),
            'odom in feet': odom(driven(3.28, 3.28), 'odom unit'),
            'odom turns half': odom(driven(yaw=0.5), 'odom yaw', '0.5|0.49'),
            'pan geared 2 to 1': joints(m.times(2.0), 'pan scale', '2'),
            'pan in ticks of a motor': joints(m.times(651.9), 'pan scale'),
            'joint_states at 2 Hz': joints(m.rarely(10), 'joint_states rate', '2.0 Hz'),
            'images clock 2 % slow': both(m.drifting(-0.02), 'images clock', '% slow'),
            'joint_states clock 3 % fast': joints(
                m.drifting(0.03), 'joint_states clock', '% fast'),
            'images +10 s': both(later(10.0), 'images clock', '(10.0|9.9)'),
            'second odometry that stands': odom(
                with_second(2, m.at_origin), 'odom sources', 'two sources'),
            'pan and tilt exchanged': joints(m.swapped_names, 'joint names', 'tilt_joint'),
            'joint stamps of whole seconds': joints(m.rounded_stamp(1.0), 'joint_states', 'twice'),
            'odom pose frozen': odom(m.frozen('pose'), 'odom', 'pose'),
            'image stamps shaken by 80 ms': images(m.shaken(0.08), 'images'),
            'no odom for 5 s': odom(m.gone(100, 200), 'odom gaps'),
        },
        # With five of room.yaml, in `bad_sweeps.errors_of`.
        'further': {
            'odom y mirrored': odom(m.mirrored, 'odom', 'mirrored'),
            'odom yaw in degrees': odom(driven(yaw=DEGREES), 'odom', 'degrees|57'),
            'odom quaternion w first': odom(m.quaternion(lambda x, y, z, w: (w, x, y, z)),
                'odom', 'quaternion|orientation|turns about|roll'),
            'odom stands from half on': odom(
                from_on(140, m.frozen('pose')), 'odom', 'stands|frozen|pose'),
            'odom jumps by 1 m': odom(from_on(140, m.moved(1.0, 0.0, 0.0)), 'odom', 'jump'),
            'pan stays from half on': joints(
                from_on(140, m.frozen('position')), '(pan|joint)', 'stays|turn|frozen'),
            'red and blue exchanged': images(
                pictured(lambda i: i[..., ::-1]), '(images|papers)', 'red and blue|rgb|colours'),
            'images cut at the left': images(pictured(lambda i: i[:, round(0.15 * i.shape[1]) :]),
                '(images|camera)', 'size|pixels|wide|principal'),
            'each second image repeated': images(
                content(lambda k: k - k % 2), 'images', 'same|repeat|twice|frozen'),
            # Each third image is of another camera, which looks elsewhere.
            'images of two cameras': images(
                content(lambda k: k - 20 if k % 3 == 2 and k > 20 else k), 'images', 'two|other'),
            'images turned by 90 deg': images(
                pictured(np.rot90), '(images|camera)', '90 deg|turned|rolled|quarter'),
            'images black from half on': images(
                from_on(35, pictured(np.zeros_like)), 'images', 'dark|black'),
            'fy 30 % long': info(m.lens(1.0, 1.3), 'camera', 'fy|focal|tall'),
            'pan_axis x and z exchanged': mount(
                '(camera|papers)', 'height|higher|lower|pan_axis xyz',
                axis_xyz=lambda xyz: xyz[::-1]),
            'camera pitched by 0.3 rad': mount(
                '(camera|papers|images)', 'pitch|tilt|lean|horizon', axis_rpy=(0.0, 0.3, 0.0)),
        },
        'third': {
            'speed of the pan as its angle': joints(m.speeds_as_angles(),
                '(pan|joint)', 'speed|velocit|not follow|does not turn'),
            'pan against the map': joints_and_odom(
                m.against_the_map(), '(pan|joint)', 'yaw|heading|map|odom'),
            'pan in steps of 0.1 rad': joints(
                m.joints(lambda position: 0.1 * np.round(position / 0.1)),
                '(pan|joint)', 'step|resolution|coarse|round'),
            'joint_states 0.2 s early': joints(later(-0.2), 'joint_states clock', '(20.|19.) ms'),
            'pan in revolutions': joints(
                m.times(0.5 / np.pi), 'pan scale', 'revolution|turns|6.2|6.3|0.15|0.16'),
            'second pan, off by 0.3 rad': joints(
                with_second(2, m.added(0.3)), 'joint_states sources', 'two sources'),
            'odom in inches': odom(
                driven(39.37, 39.37), 'odom (unit|speed|twist)', 'inch|3.\\.|times'),
            'odom x reversed': odom(
                driven(x=-1.0), '(odom|camera heading)', 'mirrored|revers|backwards|sign'),
            'odom without orientation': odom(m.quaternion(lambda *_: (0.0, 0.0, 0.0, 1.0)),
                'odom', 'orientation|not turn|does not|yaw.* 0|twist'),
            'odom path turned by 90 deg': odom(
                m.path([[0.0, -1.0], [1.0, 0.0]]), '(odom|camera heading)', '90|89|sideways'),
            'odom twist in degrees': odom(m.twist_times(1.0, DEGREES), 'odom twist', 'degrees'),
            'odom clock set by 2 s': odom(from_on(140, later(2.0)), 'odom', 'step|set|jump'),
            'odom another time zone': odom(later(3600.0), 'odom clock', '3600|3599.9'),
            # Each image comes with the stamp of the next one.
            'images one late': images(content(lambda k: k - 1), 'images clock', '(20.|19.) ms'),
            'odom turns by 0.1 rad/s': odom(m.curved(0.1, 0.0), 'odom', 'bias|drift|rad/s|deg/s'),
            'odom curves by 0.3 rad/m': odom(
                m.curved(0.0, 0.3), 'odom', 'curve|drift|rad/m|deg/m|wheel'),
            'images zoomed 1.4 times': images(m.zoomed(1.4), 'camera lens', 'short'),
            'principal point off by 100 px': info(
                m.centred(100.0, 0.0), 'camera', 'principal|heading|deg'),
            'mount given upside down': mount(
                '(images|pan|camera|papers)', 'upside down|roll', axis_rpy=(np.pi, 0.0, 0.0)),
            'optical centre off by 0.5 m': mount(
                'camera', 'offset|centre', optical_center_offset=(0.5, 0.0, 0.0)),
        },
        'fourth': {
            'zero of the pan off by 90 deg': joints(
                m.added(0.5 * np.pi), 'camera heading', '(8.|9.) deg'),
            'pan in gradians': joints(m.times(200.0 / np.pi), 'pan scale', '6[234]'),
            'pan in milliradians': joints(m.times(1000.0), 'pan scale', '1000|1e.03|99.'),
            # With their zero half a turn away.
            'pan from 0 to a turn': joints(
                m.joints(lambda position: (position + np.pi) % (2.0 * np.pi)),
                'camera heading', '1[78]. deg|backwards'),
            'pan behind a filter of 0.3 s': joints(
                m.filtered(0.3), '(joint_states clock|pan)', 'late|filter|delay'),
            'wheels a third as large': odom(
                driven(1.0 / 3.0, 1.0 / 3.0), 'odom unit', 'wheel|times'),
            'odom speed reversed': odom(m.twist_times(-1.0, 1.0), 'odom twist', 'opposite|sign'),
            'odom rate of turn reversed': odom(
                m.twist_times(1.0, -1.0), 'odom twist', 'opposite|sign'),
            'odom clock 10 % slow': odom(m.drifting(-0.1), 'odom clock', '% slow'),
            'odometry of two robots': odom(
                with_second(1, m.moved(2.0, 0.0, 0.0)), 'odom sources', 'two sources'),
            'odom of the camera': joints_and_odom(m.of_the_camera(), 'odom', 'pan|camera'),
            'each second image black': images(
                each_second(pictured(np.zeros_like)), 'images', 'dark|black|nothing'),
            'fx 20 % short': info(m.lens(0.8, 1.0), 'camera lens', 'fx|fy|focal'),
            'distortion of the other sign': info(m.distorted(-1.0), 'camera lens', 'distortion'),
            'cy off by 80 px': info(
                m.centred(0.0, 80.0), 'camera', 'principal|tilt|cy|lower|higher'),
            'camera_roll off by 10 deg': mount('camera roll', '10', camera_roll_rad=0.1745),
            'camera pitched by -0.2 rad': mount(
                'camera', 'pitch|higher|lower', axis_rpy=(0.0, -0.2, 0.0)),
            'zero of the tilt off by 0.25 rad': joints(
                m.added(0.25, 'tilt_joint'), 'camera', 'tilt|pitch|higher|lower'),
            'pan_axis xyz in cm': mount('camera mount', 'metres|axis', axis_xyz=(8.0, 0.0, 110.0)),
            'images flipped top to bottom': images(
                pictured(lambda i: i[::-1]), '(images|camera)', 'flip|mirror|upside'),
        },
        'fifth': {
            'focal length x 0.02': info(m.lens(0.02, 0.02), 'camera lens', 'focal|wide'),
            'cx off by a width': info(m.centred(600.0, 0.0), 'camera lens', 'principal|cx'),
            'K of an image of half the size': info(
                m.lens(0.5, 0.5, 0.5, 0.5), 'camera lens', 'focal|size'),
            'odom in km': odom(driven(1e-3, 1e-3), 'odom', 'times|kilomet|metres|unit'),
            'joint_states clock set back by 1 s': joints(
                from_on(140, later(-1.0)), 'joint_states', 'step|back'),
            'odom behind a filter of 0.5 s': odom(
                m.odometry_filtered(0.5), 'odom', 'late|filter|delay'),
            'pan slips by 0.3 rad': joints(
                from_on(140, m.added(0.3)), '(pan|joint|camera heading)', 'jump|step|slip|zero'),
            'pan cut off at 0.4 rad': joints(
                m.joints(lambda position: np.clip(position, -0.4, 0.4)),
                '(pan|joint)', 'stays|limit|cut|clip'),
            'pan measured at 2 Hz, sent at 20': joints(
                m.held(10), '(pan|joint)', 'hold|held|step|repeat|rate|late'),
            'odom yaw as z of its quaternion': odom(
                m.yaw_as_z, 'odom', 'quaternion|orientation|yaw'),
            'odom turns twice': odom(driven(yaw=2.0), 'odom yaw', '(2|1.9)'),
            'image stamps rounded down to 0.4 s': images(
                m.rounded_stamp(0.4), 'images (order|stamps|jitter|clock)'),
            'camera looks back': mount(
                'camera heading', '1[78]. deg|backwards', axis_rpy=(0.0, 0.0, np.pi)),
            'camera_roll of a quarter too much': mount(
                'camera roll', '(90|89) deg', camera_roll_rad=1.5708),
            'pan axis 1.2 m too far left': mount(
                'camera mount', 'axis', axis_xyz=lambda xyz: (xyz[0], 1.2, xyz[2])),
            'odom at 1 Hz': odom(m.rarely(20), 'odom rate', '1.0 Hz'),
            'pan reversed, zero off by 0.5 rad': joints(
                m.angle(lambda pan: 0.5 - pan), 'pan sign', 'reversed'),
            'd of 0 with images of a lens': info(m.distorted(0.0), 'camera lens', 'distortion'),
            'neighbouring images exchanged': images(
                content(lambda k: k - (k > 1 and k % 3 > 0)), 'images', 'order|other|repeat'),
            'images white': images(
                pictured(lambda i: np.full_like(i, 255)), 'images', 'white|nothing'),
        },
        'sixth': {
            # The recorded odometry is 11 ms late by itself (sigma 4 ms).
            'odom 0.25 s late': odom(later(0.25), 'odom clock', '2[3-6]. ms late'),
            'joint_states clock 1 % slow': joints(
                m.drifting(-0.01), 'joint_states clock', '% slow'),
            'images clock set by 0.6 s': images(from_on(35, later(0.6)), 'images clock', 'step'),
            'fy 25 % short': info(m.lens(1.0, 0.75), 'camera lens', 'fy|focal'),
            'principal point off both ways': info(
                m.centred(-80.0, 60.0), 'camera lens', 'principal'),
            'pan in tenths of degrees': joints(m.times(10.0 * DEGREES), 'pan scale', '5[67].'),
            'pan geared 1.15': joints(m.times(1.15), 'pan scale', '1\\.1'),
            'pan in degrees, reversed': joints(m.times(-DEGREES), 'pan scale', 'degrees'),
            'odom turns 1.5 times': odom(driven(yaw=1.5), 'odom yaw', '1\\.[45]'),
            'odom at 3 Hz': odom(m.rarely(7), 'odom rate', '2.9 Hz'),
            'no images for 4 s': images(m.gone(30, 50), 'images gaps', '4\\.'),
            'two calibrations in turns': info(
                m.one_in(2, m.lens(0.6, 0.6)), 'camera', 'calibration|camera_info|focal'),
            'odom begins anew': odom(from_on(140, m.from_zero()), 'odom', 'jump|reset'),
            'camera given upside down': mount('(images|camera)', 'upside', camera_roll_rad=np.pi),
            'pan axis 1 m too far ahead': mount(
                'camera mount', 'axis', axis_xyz=lambda xyz: (1.08, 0.0, xyz[2])),
            'yaw of the mount 40 deg off': mount(
                'camera heading', '(3.|4.) deg', axis_rpy=(0.0, 0.0, 0.7)),
            'one image all the time': images(content(lambda k: 0), 'images', 'same|repeat'),
            'one image in five 0.15 s late': images(
                m.one_in(5, later(0.15)), 'images (jitter|order|stamps|clock)'),
            'pan_joint that tilts': mount('joint names', 'pan_joint', pan_joint='tilt_joint'),
            'odom curves by -0.4 rad/m': odom(m.curved(0.0, -0.4), 'odom', 'curve|deg/m|wheel'),
        },
        # Tried on the study, too.
        'seventh': {
            'pose in degrees, twist in radians': odom(m.in_degrees(), 'odom', 'degrees|57'),
            'one image for 4 s': images(
                content(lambda k: 20 if 20 <= k < 40 else k), 'images motion', 'repeat'),
            'second camera of twice the focal length': images(
                each_second(m.zoomed(2.0)), 'images content', 'two cameras'),
            # Stamps of a counter that begins anew.
            'image stamps wrap at 4.096 s': images(
                m.stamps(lambda stamp: stamp % 4_096_000_000), 'images order', 'back'),
            'one wheel 5 % larger': odom(m.curved(0.0, 0.125), 'odom yaw', 'curves'),
            'nanosec in microseconds': images(m.in_microseconds, 'images stamps', 'microseconds'),
            'each second image darker': images(
                each_second(pictured(lambda i: (0.3 * i).astype(np.uint8))),
                'images exposure', 'brightness'),
            'twist in mm/s': odom(m.twist_times(1000.0, 1.0), 'odom twist', 'millimetres'),
            'odom stands for 3 s': odom(m.standing(120, 180), 'odom', 'stays'),
            'left half of the images black': images(
                pictured(m.half_black), 'images cover', 'left'),
            'images out of focus': images(
                pictured(lambda i: cv2.GaussianBlur(i, (0, 0), 6.0)), 'images sharpness', 'focus'),
            'each image sent twice': images(
                with_second(1, m.same, 30_000_000), 'images motion', 'repeat'),
        },
        'eighth': {
            'all clocks set by 54 years': StreamError((CAMERA, INFO, JOINTS, ODOMETRY),
                m.set_forward(1.7e9, 7.0), 'odom gaps', 'clock was set'),
            'odom orientation all zero': odom(
                m.quaternion(lambda *_: (0.0,) * 4), 'odom values', '280 of 280'),
            'images of two sizes': images(
                from_on(35, pictured(lambda i: i[::2, ::2])), 'images encoding', '256 x 256'),
            'joint_states without joints': joints(m.nameless, 'joint names', 'no joint'),
        },
        'ninth': {
            'joint_states -2 s': joints(later(-2.0), 'joint_states clock', '(2.0|1.9). s early'),
            'joint_states +1.7e9 s, recorded so': joints(
                later(1.7e9), 'joint_states clock', '1.7e.09', True),
            'images -0.7 s': both(later(-0.7), 'images clock', '(6|7).. ms early'),
            'odom clock set back by 3 s': odom(from_on(100, later(-3.0)), 'odom', 'back|steps'),
            'images clock set back by 1 s': both(
                from_on(35, later(-1.0)), 'images clock', 'steps back'),
            'odom clock 1 % fast': odom(m.drifting(0.01), 'odom clock', '% fast'),
            'third joint stamps all 0': joints(
                m.one_in(3, m.stamps(lambda _: 0)), 'joint_states|reading', 'stamp'),
            'odom in yards': odom(driven(1.0936, 1.0936, twist=1.0), 'odom', '1.09'),
            'odom in decimetres': odom(driven(10.0, 10.0), 'odom', 'metres'),
            'odom turns 0.6 times': odom(driven(yaw=0.6), 'odom yaw', '0.[56]'),
            'second odometry, reversed': odom(
                with_second(2, driven(-1.0, -1.0, -1.0)), 'odom sources', 'two'),
            'second pan, reversed': joints(
                with_second(1, m.times(-1.0)), 'joint_states sources', 'two sources'),
            'pan of half the angle': joints(m.times(0.5), 'pan scale', '0.5|0.4'),
            'pan jumps by 2 pi / 3 twice': joints(
                from_on(90, from_on(70, m.added(2.0944))), 'pan jumps'),
            'pan hangs for 3 s': joints(m.where(lambda k: 100 <= k < 160, m.frozen('position')),
                '(joint_states|pan)', 'stays'),
            'pan not a number in half': joints(
                each_second(m.times(np.nan)), 'reading', 'not a number'),
            'focal length 12 % short': info(m.lens(0.88, 0.88), 'camera lens', 'short'),
            'cx of a camera with half the width': info(
                m.centred(-128.0, 0.0), 'camera lens', 'principal'),
            'images upside down from half on': images(
                from_on(35, pictured(lambda i: i[::-1, ::-1])), 'images', 'upside down'),
            'camera pitched by 0.4 rad the other way': mount(
                'camera', 'pitch', axis_rpy=(0.0, -0.4, 0.0)),
            'mount turned by 180 deg, pan reversed': mount(
                '(images|pan|camera|odom)', 'upside', axis_rpy=(np.pi, 0.0, np.pi)),
        },
        'tenth': {
            'pan hangs': joints(m.frozen('position'), 'joint_states values', 'does not move'),
            'odom hangs': odom(
                m.chained(m.frozen('pose'), m.frozen('twist')), 'odom values', 'does not change'),
            'focal length steps by 20 %': info(
                from_on(40, m.lens(1.2, 1.2)), 'camera zoom', '20 %'),
            'one image in seven stamped before 1970': images(
                m.one_in(7, m.stamps(lambda _: -5 * m.NS)), 'images values', '1[01] of 70'),
            'one image in seven stamped in 2038': images(
                m.one_in(7, m.stamps(lambda _: (2**31 - 1) * m.NS)), 'images values', '1[01] of'),
        },
    }


def of_sweeps():
    """Errors of recorded sweeps, which users reported."""
    return {
        'pan reversed': trajectory(m.swept(-1.0), 'pan sign', 'reversed'),
        'pan in degrees': trajectory(m.swept(DEGREES), 'pan scale', 'degrees'),
        'pan in ticks': trajectory(m.swept(651.9), 'pan scale', '65.'),
        'pushed by 8 deg': trajectory(
            m.pushed(36, np.radians(8.0)), 'sweep motion', 'base turned'),
        'first sweep in reverse': swept(m.in_reverse(72), 'pan sign', 'sweep 1: .*reversed'),
        'camera upside down': swept(pictured(lambda i: i[::-1, ::-1]), 'pan sign', 'upside down'),
        'images turned by 90 deg': swept(pictured(np.rot90), 'camera roll'),
        'images cropped': swept(
            pictured(lambda i: i[64:-64, 64:-64]), 'images encoding', 'camera_info is for'),
        'K of twice the size': StreamError(
            ('sweep/camera_info',), m.lens(2.0, 2.0, 2.0, 2.0), 'camera lens', 'at the size of'),
    }
# fmt: on
