"""Rooms, robots, cameras and calibrations: their files, and what was observed."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.simulation.setup_documents import robot_document
from landmark_nav.storage.robot_files import (
    load_calibration,
    load_odometry,
    load_robot,
    save_calibration,
)
from landmark_nav.storage.setup_files import load_camera, load_room

ROOM = """\
frame_id: hall
walls:
- {id: south, start: [0, 0], end: [4, 0], height: 2.5}
- {id: east, start: [4, 0], end: [4, 3], height: 2.5}
- {id: slant, start: [4, 3], end: [0, 0], height: 2.5}
reference_area:
  papers:
  - {color: red, center: [1, 0, 1.5], width: 0.2, height: 0.3}
"""
ROBOT = """\
pan_joint: neck
pan_axis: {xyz: [0.1, 0, 1.1], rpy: [0, 0, 0.2]}
optical_center_offset: [0.05, 0, 0.02]
"""

CAMERA = """\
image_width: 640
image_height: 480
camera_name: eye
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 322, 0, 502, 236, 0, 0, 1]}
distortion_model: equidistant
distortion_coefficients: {rows: 1, cols: 4, data: [-0.02, 0.003, 0, 0]}
"""


def written(folder, text):
    path = folder / 'setup.yaml'
    path.write_text(text, encoding='utf-8')
    return path


def test_robot_as_written_and_defaults(tmp_path):
    mount = load_robot(written(tmp_path, ROBOT))
    assert mount.axis_xyz == (0.1, 0, 1.1)
    assert mount.axis_rpy == (0, 0, 0.2)
    assert mount.optical_center_offset == (0.05, 0, 0.02)
    names = (mount.base_frame, mount.pan_joint, mount.tilt_joint)
    assert names == ('base_link', 'neck', 'tilt_joint')
    bare = load_robot(written(tmp_path, 'pan_axis: {xyz: [0, 0, 1]}'))
    assert bare.axis_rpy == bare.optical_center_offset == (0.0, 0.0, 0.0)
    assert bare.camera_roll_rad == 0.0
    # Fields of another program stay unread.
    assert load_robot(written(tmp_path, ROBOT + 'note: by hand\nwheels: 2\n')) == mount
    rolled = replace(bare, camera_roll_rad=3.1416)
    assert load_robot(written(tmp_path, robot_document(rolled))) == rolled


@pytest.mark.parametrize(
    ('load', 'text', 'message'),
    [
        (load_room, '- 1', 'holds no mapping'),
        (load_room, '', 'walls is missing'),
        (load_room, ROBOT, 'this is a robot file: give it as --robot'),
        (load_robot, ROOM, 'this is a room file: give it as --room'),
        (load_room, 'walls:\n\t- 1', 'line 2: a tab: indent with spaces'),
        (load_room, 'a: 2\nb: [1', r'not YAML: line \d: .*expected'),
        (load_room, 'a: \x07', 'not YAML: '),
        (load_room, 'walls: 3', 'walls is 3, not a list'),
        (load_room, 'walls: [3]', r'walls\[0\] is 3, not a mapping'),
        *(
            (load_room, ROOM.replace(old, new, 1), message)
            for old, new, message in (
                ('start: [0, 0]', 'start: [0]', r'walls\[0\]: start is .*not 2 numbers'),
                ('start: [0, 0]', 'start: [0, yes]', r'walls\[0\]: start is .*not 2 numbers'),
                ('height: 2.5', 'height: true', r'walls\[0\]: height is True, not a'),
                ('height: 2.5', 'height: .nan', r'walls\[0\]: height is nan: not finite'),
                ('height: 2.5', 'height: 250', 'wall south is 250 m high: lengths are m'),
                ('height: 2.5', 'hieght: 2.5', 'hieght is no field: write height'),
                ('end: [4, 3]', 'end: [4, 2]', 'the walls are open: wall east'),
                ('id: east', 'id: south', 'two walls are called south'),
                ('id: east', 'id: [east]', r"walls\[1\]: id is \['east'\], not a name"),
                ('reference_area', 'reference_ara', 'reference_ara is no field: write refe'),
                ('frame_id: hall', 'frame_id: odom', 'frame_id is odom, which the robot moves'),
                ('frame_id: hall', 'frame_id:', 'frame_id is None, not a name'),
                ('color: red, ', '', r'papers\[0\]: color is missing'),
                ('color: red', 'colour: red', r'papers\[0\]: colour is no field: write color'),
                ('color: red', 'color: beige', r"papers\[0\]: paper colour 'beige' is not known"),
                ('color: red', "color: '#777777'", r'papers\[0\]: .* too grey'),
                ('height: 0.3', 'height: 297', r'papers\[0\]: .* is no size of a paper: .* met'),
                ('[1, 0, 1.5]', '[3, 0.6, 1.5]', r'papers\[0\] \(red\) is 60 cm from its near'),
                ('[1, 0, 1.5]', '[1, 0, 2.8]', r'papers\[0\] \(red\) is 30 cm from its nearest'),
                ('[1, 0, 1.5]', '[1, -0.11, 1.5]', r'papers\[0\] \(red\) is 11 cm from'),
            )
        ),
        *(
            (
                load_room,
                ROOM + f'  markers: [{{number: 1, {one}}}, {{{other}, size: 0.1}}]',
                message,
            )
            for one, other, message in (
                ('size: 0.1', 'number: 2, center: [1, 0, 1]', r'markers\[0\]: center is missing'),
                ('center: [1, 0, 1], size: 16', 'number: 2', r'markers\[0\]: 16 m is no size'),
                ('center: [1, 0, 1], size: 0.1', 'number: x', r"markers\[1\]: number is 'x'"),
                ('center: [1, 0, 1], size: 0.1', 'number: 1, center: [1, 0, 2]', 'there twice'),
                (
                    'center: [1, 0, 1], size: 0.1',
                    'number: 50, center: [1, 0, 2]',
                    r'markers\[1\]: number is 50: DICT_4X4_50 has 0 to 49: give another',
                ),
                (
                    'center: [1, 0, 1], size: 0.1',
                    'number: 2, center: [1, 1, 1]',
                    'number 2. is 20 cm',
                ),
            )
        ),
        (load_room, ROOM[: ROOM.index('  papers')].replace('area:', 'area: 5'), 'not a mapping'),
        (load_room, ROOM + '  marker_dictionary: DICT_9\n', 'dictionary .*DICT_9.*: take one'),
        (load_room, ROOM.replace('[4, ', '[4000, '), 'wall south is 4000 m long: lengths are m'),
        (load_robot, 'base_frame: base_link', 'pan_axis is missing'),
        (load_robot, 'pan_axis: 3', 'pan_axis is 3, not a mapping'),
        (load_robot, 'pan_axis: {xyz: [0, 0, high]}', 'xyz is .*high.*not 3 numbers'),
        (load_robot, 'pan_axis: {xyz: [0, 0, 1], rpy: 0}', 'rpy is 0, not 3 numbers'),
        (load_robot, 'pan_axis: {xyz: [0, 0, 1], rpy: [0, 0, 90]}', 'rpy is .*90.*in radians'),
        (load_robot, 'pan_axis: {xyz: [8, 0, 110]}', r'pan_axis: xyz is \[8.*: lengths are met'),
        (load_robot, 'pan_axs: {xyz: [0, 0, 1]}', 'pan_axs is no field: write pan_axis'),
        (load_robot, 'pan_axis: {xzy: [0, 0, 1]}', 'pan_axis: xzy is no field: write xyz'),
        *(
            (load_robot, f'pan_axis: {{xyz: [0, 0, 1]}}\n{line}', message)
            for line, message in (
                ('optical_center_offset: [1]', 'optical_center_offset is'),
                ('optical_center_offset: [40, 0, 0]', r'offset is \[40.*\]: lengths are metres'),
                ('optical_centre_offset: [0, 0, 0]', 'write optical_center_offset'),
                ('camera_roll: over', "camera_roll is 'over', not a number"),
                ('camera_roll: 180', 'camera_roll is 180: .* in radians'),
                ('tilt_joint: pan_joint', 'pan_joint and tilt_joint are both'),
                ("pan_joint: ''", "pan_joint is '', not a name"),
                ('pan_min: -90', 'pan_min is -90.*radians'),
                ('pan_min: 1\npan_max: -1', 'swap'),
                ('pan_rate: 0', 'pan_rate is 0'),
            )
        ),
        (load_camera, CAMERA.replace('640', 'wide'), "image_width is 'wide'"),
        (load_camera, CAMERA.replace('equidistant', 'omni'), "camera model 'omni' is not supp"),
        (load_camera, CAMERA.replace('[500, 0, 322,', '[500, 322,'), 'data is .* not 9 numbers'),
        (load_camera, CAMERA.replace('data: [-', 'no: [-'), 'coefficients: data is missing'),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, load, text, message):
    path = written(tmp_path, text)
    with pytest.raises(LandmarkNavError, match=message) as caught:
        load(path)
    assert str(caught.value).startswith(f'{path}: ')
    assert '\n' not in str(caught.value)


def test_a_calibration_as_ros_keeps_it(tmp_path):
    camera = load_camera(written(tmp_path, CAMERA))
    assert camera == CameraModel(
        640, 480, 500.0, 502.0, 322.0, 236.0, 'equidistant', (-0.02, 0.003)
    )


MOUNT = PanTiltMount((0.1, 0.02, 1.2), (0.01, -0.02, 0.3), (0.03, -0.01, 0.02), 0.04, 3e-4)
BARE_ROBOT = {'pan_axis': {'xyz': [0.1, 0.02, 1.2]}}


def robot_file(path, document):
    file = path / 'robot.yaml'
    file.write_text(yaml.safe_dump(document), encoding='utf-8')
    return file


def test_fields_that_do_nothing_are_named(tmp_path, caplog):
    (tmp_path / 'robot.yaml').write_text('pan_axis: {xyz: [0, 0, 1]}\nmast: 3\nwheels: [1]\n')
    load_calibration(tmp_path / 'robot.yaml')
    (message,) = caplog.messages
    assert 'mast' in message
    assert 'wheels' in message
    assert 'pan_axis' not in message


def test_a_file_without_sigmas_stays_valid(tmp_path):
    found = load_calibration(robot_file(tmp_path, BARE_ROBOT))
    assert found.mount.axis_xyz == (0.1, 0.02, 1.2)
    assert found['axis_x'] == (0.1, 0.02)
    assert found['axis_yaw'] == (0.0, 0.017)
    assert found['focal_scale'] == (0.0, 0.01)
    assert found['joint_delay'] == (0.0, 0.03)


@pytest.mark.parametrize(
    'odometry', [3, {'along': 0.1}, {'max_gap_s': 'x'}, {'along_m_per_sqrt_m': -1}]
)
def test_noise_that_cannot_be_is_named(tmp_path, odometry):
    path = robot_file(tmp_path, {'pan_axis': {'xyz': [0, 0, 1]}, 'odometry': odometry})
    with pytest.raises(LandmarkNavError, match=rf'{path.name}: odometry'):
        load_odometry(path, OdometryNoiseConfig())


def test_survives_its_file_with_what_errs_together(tmp_path, caplog):
    rng = np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(len(NAMES), 4))
    values = Calibration.of_mount(MOUNT).values + 1e-3 * rng.normal(size=len(NAMES))
    before = Calibration(values, root @ root.T, MOUNT)
    save_calibration(before, tmp_path / 'robot.yaml')
    after = load_calibration(tmp_path / 'robot.yaml')
    assert not caplog.records
    assert after.values == pytest.approx(before.values, abs=1e-9)
    assert after.covariance == pytest.approx(before.covariance, abs=1e-11)
    assert after.base.pan_sigma_rad == MOUNT.pan_sigma_rad
    assert load_robot(tmp_path / 'robot.yaml').axis_xyz == pytest.approx(before.mount.axis_xyz)


WRONG = {
    'joint_delay': ('soon', 5.0),
    'focal_scale': (float('nan'),),
    'camera_tilt': (12.0,),
    'camera_roll_sigma': (-0.1,),
    'joint_delay_sigma': (float('inf'), [0.1, 0.2], True, None),
    'focal_scale_sigma': (20.0,),
    'optical_center_offset_sigma': ([0.1, 0.1], [0.1, [0.1], 0.1]),
    'focal_scale_sigmas': (0.1,),
    'pan_axis.xyz_sigma': (20, -0.02),
    'pan_axis.rpy_sigma': ('x',),
    'pan_axis.xyz_sigmas': (0.1,),
    'correlations': (
        3,
        *([['axis_yaw', 'principal_point', *of]] for of in ((), (1.5,), ('much',), (np.nan,))),
        [['axis_yaw', 'axis_yaw', 0.5]],
        [['axis_yaw', 'zoom', 0.5]],
        [[['axis_yaw'], 'principal_point', 0.5]],
        [
            ['axis_yaw', 'principal_point', 1.0],
            ['axis_yaw', 'focal_scale', 1.0],
            ['principal_point', 'focal_scale', -1.0],
        ],
    ),
}


@pytest.mark.parametrize(
    ('name', 'value'), [(k, v) for k, values in WRONG.items() for v in values]
)
def test_states_which_field_is_wrong(tmp_path, name, value):
    section, _, field = name.rpartition('.')
    changes = {'pan_axis': {**BARE_ROBOT['pan_axis'], field: value}} if section else {name: value}
    file = robot_file(tmp_path, {**BARE_ROBOT, **changes})
    # Correlations that contradict each other are those of the whole calibration.
    words = {'correlations': 'correlations|calibration: '}.get(
        field, field.replace('sigmas', 'sigma')
    )
    with pytest.raises(LandmarkNavError, match=words) as caught:
        load_calibration(file)
    assert str(file) in str(caught.value)
    assert '\n' not in str(caught.value)
    assert len(str(caught.value).replace(str(tmp_path), '')) < 200


@pytest.mark.parametrize('degraded', [np.nan, np.inf])
def test_takes_numbers_only(degraded):
    good = Calibration.of_mount(MOUNT)
    with pytest.raises(LandmarkNavError):
        Calibration(np.full(len(NAMES), degraded), good.covariance, MOUNT)
    with pytest.raises(LandmarkNavError):
        Calibration(good.values, -good.covariance, MOUNT)


def test_a_measurement_is_weighed_against_what_is_known():
    prior = Calibration.of_mount(MOUNT, {'axis_yaw': 0.02})
    found = prior.measured('axis_yaw', MOUNT.axis_rpy[2] + 0.01, 0.02)
    assert found['axis_yaw'] == pytest.approx((MOUNT.axis_rpy[2] + 0.005, 0.02 / np.sqrt(2.0)))
    others = [k for k, name in enumerate(NAMES) if name != 'axis_yaw']
    np.testing.assert_array_equal(found.values[others], prior.values[others])


def test_a_sum_moves_its_parts_and_their_difference_stays_unknown():
    prior = Calibration.of_mount(MOUNT)
    row = np.isin(NAMES, ('axis_z', 'center_z')).astype(float)
    total = float(row @ prior.values) + 0.03
    found = prior.observed(row[None], np.array([total]), np.array([[1e-6]]))
    assert row @ found.values == pytest.approx(total, abs=1e-4)
    assert np.sqrt(row @ found.covariance @ row) == pytest.approx(1e-3, rel=0.01)
    assert found['axis_z'][1] > 0.01


@pytest.mark.parametrize('sigma', [0.001, 0.0001])
def test_what_contradicts_the_given_sigma_counts_by_itself(sigma):
    prior = Calibration.of_mount(MOUNT, {'axis_yaw': sigma})
    found = prior.measured('axis_yaw', MOUNT.axis_rpy[2] + 0.1, 0.002)
    assert found['axis_yaw'][0] == pytest.approx(MOUNT.axis_rpy[2] + 0.1, abs=1e-3)
    assert found['axis_yaw'][1] < 0.0021
    assert 'axis_yaw' in found.surprises(prior)


def test_what_is_exact_stays_or_is_contradicted():
    prior = Calibration.of_mount(MOUNT, {'axis_yaw': 0.0})
    near = prior.measured('axis_yaw', MOUNT.axis_rpy[2] + 0.001, 0.001)
    assert near['axis_yaw'] == (MOUNT.axis_rpy[2], 0.0)
    with pytest.raises(LandmarkNavError, match=r'axis_yaw.*\+5\.7'):
        prior.measured('axis_yaw', MOUNT.axis_rpy[2] + 0.1, 0.001)


def test_a_wall_may_be_promised_to_be_exact(tmp_path):
    room = load_room(written(tmp_path, ROOM.replace('height: 2.5}', 'height: 2.5, sigma_m: 0}')))
    assert all(0.0 < wall.sigma_m <= 1e-3 for wall in room.walls)
