"""URDF: the mount of a robot by its joints, and what is refused."""

import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import BODY_FROM_OPTICAL
from landmark_nav.geometry.se2 import rot_y, rot_z, rotation_rpy
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


def test_mount_agrees_with_the_joints(tmp_path):
    """The camera is where the chain of joints puts it, at any pan."""
    known = read(tmp_path / 'r.urdf', robot(*USUAL))
    base = (0.0, 0.0, 0.06), np.eye(3)
    for pan in (-1.0, 0.0, 2.0):
        center, turn = base
        for xyz, rotation in (
            ([0.1, 0.01, 0.5], rotation_rpy([0.0, 0.01, 0.0])),
            ([0.0, 0.0, 0.4], rot_z(0.02) @ rot_z(pan)),
            ([0.01, 0.0, 0.05], np.eye(3)),
            ([0.03, 0.02, 0.01], rotation_rpy([0.02, 0.03, 0.05])),
            ([0.0, 0.015, 0.0], BODY_FROM_OPTICAL),
        ):
            center, turn = center + turn @ np.array(xyz), turn @ rotation
        camera_tilt = known['camera_tilt'][0]
        rotation, place = known.mount.camera_pose_base(pan, camera_tilt)
        assert rotation == pytest.approx(turn, abs=1e-9)
        assert place == pytest.approx(center, abs=1e-9)
    mount = known.mount
    assert (mount.pan_joint, mount.tilt_joint) == ('pan_joint', 'tilt_joint')
    assert (*mount.pan_limits_rad, mount.pan_rate_rad_s) == (-2.5, 2.7, 1.5)
    assert known['axis_x'][1] > 0.0  # drawings of robots are no measurements


@pytest.mark.parametrize('down', [False, True])
@pytest.mark.parametrize('seed', range(5))
def test_any_pan_unit(tmp_path, seed, down):
    """Axes up or down, cameras turned and shifted at random: as by composition of the joints."""
    rng = np.random.default_rng(seed)
    mast, camera = rng.normal(0.0, 0.05, 3), rng.normal(0.0, 0.2, 3)
    places = rng.normal(0.0, 0.3, (2, 3))
    written = [' '.join(map(repr, map(float, part))) for part in (*places, mast, camera)]
    axis = f'<axis xyz="0 0 {-1 if down else 1}"/>'
    text = robot(
        joint('p', 'base_link', 'pan_link', written[0], written[2], 'continuous', axis),
        joint('c', 'pan_link', 'camera', written[1], written[3]),
        joint('o', 'camera', 'camera_optical_frame', '0 0 0', OPTICAL),
    )
    known = read(tmp_path / 'r.urdf', text)
    pan = rng.uniform(-3.0, 3.0)
    turn = rotation_rpy(mast) @ rot_z(-pan if down else pan)
    rotation, center = known.mount.camera_pose_base(pan, known['camera_tilt'][0])
    assert rotation == pytest.approx(turn @ rotation_rpy(camera) @ BODY_FROM_OPTICAL, abs=1e-9)
    assert center == pytest.approx(places[0] + turn @ places[1], abs=1e-9)


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


def test_a_tilt_axis_above_the_pan_joint(tmp_path):
    """Where the joint tilts, too, the camera is where the chain puts it."""
    known = read(tmp_path / 'r.urdf', robot(*USUAL).replace('0.01 0 0.05', '0 0 0.05'))
    tilt = 0.3
    camera_tilt = known['camera_tilt'][0]
    _, place = known.mount.camera_pose_base(0.5, tilt + camera_tilt)
    mast = rotation_rpy([0.0, 0.01, 0.0])
    turn = mast @ rot_z(0.02 + 0.5)
    center = np.array([0.1, 0.01, 0.56]) + mast @ [0.0, 0.0, 0.4] + turn @ [0.0, 0.0, 0.05]
    turn = turn @ rot_y(-tilt)
    center = center + turn @ [0.03, 0.02, 0.01]
    center = center + turn @ rotation_rpy([0.02, 0.03, 0.05]) @ [0.0, 0.015, 0.0]
    # The yaw of the camera turns its tilt axis, too.
    assert place == pytest.approx(center, abs=1e-3)


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


def test_a_unit_that_hangs_tilts_too(tmp_path):
    """With both axes turned over, the camera is where the chain of joints puts it."""
    text = robot(
        joint(
            'p', 'base_link', 'pan_link', '0 0 1', '0 0 0', 'revolute', PAN.replace('1"', '-1"', 1)
        ),
        joint(
            't', 'pan_link', 'tilt_link', '0 0 0', '0 0 0', 'revolute', TILT.replace('-1', '1', 1)
        ),
        joint('o', 'tilt_link', 'camera_optical_frame', '0.03 0.01 0.02', OPTICAL),
    )
    known = read(tmp_path / 'r.urdf', text)
    rotation, center = known.mount.camera_pose_base(0.5, 0.3 + known['camera_tilt'][0])
    turn = rot_z(-0.5) @ rot_y(0.3)
    assert rotation == pytest.approx(turn @ BODY_FROM_OPTICAL, abs=1e-9)
    assert center == pytest.approx(turn @ [0.03, 0.01, 0.02] + [0.0, 0.0, 1.0], abs=1e-9)


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
