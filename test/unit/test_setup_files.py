from dataclasses import replace

import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.simulation.setup_documents import robot_document
from landmark_nav.storage.setup_files import load_camera, load_robot, load_room

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
    assert (mount.base_frame, mount.pan_joint, mount.tilt_joint) == (
        'base_link',
        'neck',
        'tilt_joint',
    )
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
                ('color: red', 'color: beige', r"papers\[0\]: paper colour 'beige' is not known"),
                ('color: red', "color: '#777777'", r'papers\[0\]: .* too grey'),
                ('height: 0.3', 'height: 297', r'papers\[0\]: .* is no size of a paper: .* met'),
                ('[1, 0, 1.5]', '[3, 0.6, 1.5]', r'papers\[0\] \(red\) is 60 cm from its near'),
                ('[1, 0, 1.5]', '[1, 0, 2.8]', r'papers\[0\] \(red\) is 30 cm from its nearest'),
                ('[1, 0, 1.5]', '[1, -0.11, 1.5]', r'papers\[0\] \(red\) is 11 cm from'),
            )
        ),
        (load_room, ROOM.replace('[4, ', '[4000, '), 'wall south is 4000 m long: lengths are m'),
        (load_robot, 'base_frame: base_link', 'pan_axis is missing'),
        (load_robot, 'pan_axis: 3', 'pan_axis is 3, not a mapping'),
        (load_robot, 'pan_axis: {xyz: [0, 0, high]}', 'xyz is .*high.*not 3 numbers'),
        (load_robot, 'pan_axis: {xyz: [0, 0, 1], rpy: 0}', 'rpy is 0, not 3 numbers'),
        (load_robot, 'pan_axis: {xyz: [0, 0, 1], rpy: [0, 0, 90]}', 'rpy is .*90.*in radians'),
        (load_robot, 'pan_axis: {xyz: [8, 0, 110]}', r'pan_axis: xyz is \[8.*: lengths are met'),
        (load_robot, 'pan_axs: {xyz: [0, 0, 1]}', 'pan_axs is no field: write pan_axis'),
        *(
            (load_robot, f'pan_axis: {{xyz: [0, 0, 1]}}\n{line}', message)
            for line, message in (
                ('optical_center_offset: [1]', 'optical_center_offset is'),
                ('optical_center_offset: [40, 0, 0]', r'offset is \[40.*\]: lengths are metres'),
                ('optical_centre_offset: [0, 0, 0]', 'write optical_center_offset'),
                ('camera_roll: over', "camera_roll is 'over', not a number"),
                ('camera_roll: 180', 'camera_roll is 180, .* in radians'),
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
