"""URDF: the mount of a robot by its joints, and what is refused."""

from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.se2 import rotation_rpy
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.storage.robot_files import load_calibration, load_odometry

PAN = '<axis xyz="0 0 1"/><limit lower="-2.5" upper="2.7" velocity="1.5" effort="1"/>'
TILT = '<axis xyz="0 -1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/>'
OPTICAL = '-1.5707963267948966 0 -1.5707963267948966'


def joint(name, parent, child, xyz='0 0 0', rpy='0 0 0', kind='fixed', more=''):
    """Text of a joint."""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/>{more}</joint>'
    )


def robot(*joints):
    """Text of a URDF of joints."""
    return f'<?xml version="1.0"?><robot name="r">{"".join(joints)}</robot>'


USUAL = (
    joint('base_joint', 'base_footprint', 'base_link', '0 0 0.06'),
    joint('mast', 'base_link', 'mast', '0.1 0.01 0.5', '0 0.01 0'),
    joint('pan_joint', 'mast', 'pan_link', '0 0 0.4', '0 0 0.02', 'revolute', PAN),
    joint('tilt_joint', 'pan_link', 'tilt_link', '0.01 0 0.05', '0 0 0', 'revolute', TILT),
    joint('camera_joint', 'tilt_link', 'camera_link', '0.03 0.02 0.01', '0.02 0.03 0.05'),
    joint('optical', 'camera_link', 'camera_optical_frame', '0 0.015 0', OPTICAL),
)


def read(path, text, frame=''):
    """Calibration of the text of a URDF, read from a file at `path`."""
    path.write_text(text)
    return load_calibration(f'{path}:{frame}' if frame else path)


def camera_by_joints(text, **angles):
    """Where the chain of joints puts the optical frame, by angles of some: rotation and place."""
    joints = {one.find('child').get('link'): one for one in ElementTree.fromstring(text)}
    link, turn, place = 'camera_optical_frame', np.eye(3), np.zeros(3)
    while link in joints:
        one, axis = joints[link], joints[link].find('axis')
        xyz, rpy = (np.array(one.find('origin').get(k).split(), float) for k in ('xyz', 'rpy'))
        along = np.zeros(3) if axis is None else np.array(axis.get('xyz').split(), float)
        own = rotation_rpy(rpy) @ cv2.Rodrigues(angles.get(one.get('name'), 0.0) * along)[0]
        turn, place, link = own @ turn, xyz + own @ place, one.find('parent').get('link')
    return turn, place


def pan_unit(seed, down):
    """A camera turned and shifted at random on a unit that leans, with its axis up or down."""
    rng = np.random.default_rng(seed)
    mast, camera, *places = rng.normal(0.0, [[0.05], [0.2], [0.3], [0.3]], (4, 3))
    mast, camera, *places = (' '.join(map(str, k)) for k in (mast, camera, *places))
    axis = f'<axis xyz="0 0 {-1 if down else 1}"/>'
    return robot(
        joint('pan_joint', 'base_link', 'pan_link', places[0], mast, 'continuous', axis),
        joint('c', 'pan_link', 'camera', places[1], camera),
        joint('o', 'camera', 'camera_optical_frame', '0 0 0', OPTICAL),
    )


PAN_DOWN, TILT_DOWN = PAN.replace('1"', '-1"', 1), TILT.replace('-1', '1', 1)
HANGING = robot(
    joint('pan_joint', 'base_link', 'pan_link', '0 0 1', '0 0 0', 'revolute', PAN_DOWN),
    joint('tilt_joint', 'pan_link', 'tilt_link', '0 0 0', '0 0 0', 'revolute', TILT_DOWN),
    joint('o', 'tilt_link', 'camera_optical_frame', '0.03 0.01 0.02', OPTICAL),
)
ABOVE = robot(*USUAL).replace('0.01 0 0.05', '0 0 0.05')


@pytest.mark.parametrize(
    ('text', 'pan', 'tilt', 'within'),
    [
        *((robot(*USUAL), pan, 0.0, 1e-9) for pan in (-1.0, 0.0, 2.0)),
        *((pan_unit(seed, seed % 2), 0.6 * seed - 3.0, 0.0, 1e-9) for seed in range(10)),
        (HANGING, 0.5, 0.3, 1e-9),
        # With its tilt axis above the pan joint; the yaw of the camera turns that axis, too.
        (ABOVE, 0.5, 0.3, 1e-3),
    ],
)
def test_the_camera_is_where_the_chain_of_joints_puts_it(tmp_path, text, pan, tilt, within):
    known = read(tmp_path / 'r.urdf', text)
    turn, place = camera_by_joints(text, pan_joint=pan, tilt_joint=tilt)
    rotation, center = known.mount.camera_pose_base(pan, tilt + known['camera_tilt'][0])
    assert center == pytest.approx(place, abs=within)
    assert rotation == pytest.approx(turn, abs=20.0 * within)


def test_names_limits_and_sigmas(tmp_path):
    known = read(tmp_path / 'r.urdf', robot(*USUAL))
    mount = known.mount
    assert (mount.pan_joint, mount.tilt_joint) == ('pan_joint', 'tilt_joint')
    assert (*mount.pan_limits_rad, mount.pan_rate_rad_s) == (-2.5, 2.7, 1.5)
    assert known['axis_x'][1] > 0.0  # drawings of robots are no measurements


def test_one_of_several_cameras(tmp_path):
    """A camera that does not turn is left aside; of two that turn, one is to be named."""
    fixed = joint('rear', 'base_link', 'rear_optical_frame', '-0.2 0 0.3')
    assert read(tmp_path / 'a.urdf', robot(*USUAL, fixed)).mount.pan_joint == 'pan_joint'
    second = joint('depth', 'camera_link', 'depth_optical_frame', '0 0.05 0', OPTICAL)
    with pytest.raises(LandmarkNavError, match='depth_optical_frame'):
        read(tmp_path / 'b.urdf', robot(*USUAL, second))
    one, other = (
        read(tmp_path / 'b.urdf', robot(*USUAL, second), frame)['center_y'][0]
        for frame in ('camera_optical_frame', 'depth_optical_frame')
    )
    assert other - one == pytest.approx(0.035, abs=1e-3)


def test_joints_that_do_not_turn_the_camera_have_no_effect(tmp_path):
    """Fixed joints without an axis, wheels without limits, a camera on a lift."""
    others = (
        joint('mark', 'base_link', 'mark', more='<axis xyz="0 0 0"/>'),
        joint('wheel', 'base_link', 'wheel', kind='continuous', more='<limit velocity="inf"/>'),
        joint('lift', 'base_link', 'lift', kind='prismatic', more=PAN),
        joint('hand', 'lift', 'hand_optical_frame', rpy=OPTICAL),
    )
    known, alone = (
        read(tmp_path / f'{name}.urdf', robot(*USUAL, *more))
        for name, more in (('a', others), ('b', ()))
    )
    assert (known.values == alone.values).all()
    unlimited = robot(*USUAL).replace('-2.5', '-1000').replace('"1.5"', '"1000"')
    mount = read(tmp_path / 'c.urdf', unlimited).mount
    assert mount.pan_limits_rad == pytest.approx((-np.pi, np.pi))


def test_defaults_of_the_odometry(tmp_path):
    """A URDF says nothing of the noise of the wheels."""
    (tmp_path / 'r.urdf').write_text(robot(*USUAL))
    assert load_odometry(tmp_path / 'r.urdf', OdometryNoiseConfig()) == OdometryNoiseConfig()


def without(name, *more):
    """Text of the usual robot without a joint, with others."""
    return robot(*(text for text in USUAL if f'name="{name}"' not in text), *more)


SLIDES = joint('pan_joint', 'mast', 'pan_link', kind='prismatic', more=PAN)
DOWN = joint('tilt_joint', 'pan_link', 'tilt_link', kind='revolute', more='<axis xyz="0 1 0"/>')
LYING = joint('pan_joint', 'mast', 'pan_link', kind='revolute', more='<axis xyz="1 0 0"/>')
LOOP = joint('mast', 'camera_link', 'mast')


@pytest.mark.parametrize(
    'text',
    [
        'no XML',
        '<robot',
        '<robot/>',
        '<!DOCTYPE r [<!ENTITY a "b">]><robot>&a;</robot>',
        '<?xml version="1.0" encoding="nonsense"?><robot/>',
        without('pan_joint'),
        without('pan_joint', SLIDES),
        without('pan_joint', LYING),
        without('tilt_joint', DOWN),
        without('mast', LOOP),
        robot(*USUAL).replace('0.1 0.01 0.5', '${x} 0 0'),
        robot(*USUAL).replace('0.1 0.01 0.5', 'nan 0 0'),
        robot(*USUAL).replace('0.1 0.01 0.5', '100 0 0'),
        robot(*USUAL).replace('axis xyz="0 0 1"', 'axis xyz="0 0 0"'),
        robot(*USUAL).replace('lower="-2.5"', 'lower="x"'),
    ],
)
def test_bad_files(tmp_path, text):
    """Each is refused in one line that names the file."""
    with pytest.raises(LandmarkNavError) as error:
        read(tmp_path / 'r.urdf', text)
    line = str(error.value)
    assert 'r.urdf' in line
    assert '\n' not in line
    assert len(line.replace(str(tmp_path), '')) < 200


@pytest.mark.parametrize(
    ('text', 'frame', 'message'),
    [
        (robot(*USUAL), 'head', 'head.*: take one of .*camera_optical_frame'),
        (robot(*USUAL), 'camera_link', "camera_link' looks .*z along the view"),
        (robot(*USUAL).replace('base_link', 'chassis'), '', 'no .*base_link: .*base_footprint'),
        (
            robot(*USUAL).replace('"0 0 1"', '"0 0 -1"'),
            '',
            'tilt_joint: .*downwards, as pan_joint',
        ),
    ],
)
def test_what_to_do_is_named(tmp_path, text, frame, message):
    with pytest.raises(LandmarkNavError, match=message) as error:
        read(tmp_path / 'r.urdf', text, frame)
    assert len(str(error.value).replace(str(tmp_path), '')) < 200
