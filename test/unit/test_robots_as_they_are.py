"""Joints, frames, stamps and topics as robots publish them."""

from functools import cache

from bag_writers import FACTORY, MOUNT, SECOND, START, write_drive
from drive_faults import recorded, write_bag
from drive_faults import rewritten as rewritten_topics
import message_changes as m
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from landmark_nav.calibration import Calibration
from landmark_nav.diagnosis import diagnose
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.se2 import rotation_rpy
from landmark_nav.messages import encode
from landmark_nav.messages.factory import default_typestore
from landmark_nav.simulation.pan_tilt_unit import PanTiltConfig, PanTiltUnit
from landmark_nav.storage.bags import Bag, sensor_events
from landmark_nav.storage.bags.timelines import JointHistory
from landmark_nav.storage.bags.transforms import RobotTransforms
from landmark_nav.storage.robot_files import load_robot
from landmark_nav.types import CameraFrame, JointSample, OdometrySample

PANS = 0.3 * (0.2 * np.arange(10) + 0.02)
WITHOUT_STAMP = m.stamps(lambda _: 0)


def rewritten(tmp_path, change, topics=lambda topic: topic):
    """A drive with each message changed; `change` may leave one out or give several."""
    sent = recorded(write_drive(tmp_path / 'drive'))
    changed = ((topics(t), m, log) for *one, log in sent for t, m in change(*one))
    return write_bag(tmp_path / 'changed', changed)


def changed(tmp_path, topic, change):
    """A drive with the messages of one topic changed."""
    return rewritten_topics(
        write_drive(tmp_path / 'drive'), tmp_path / 'changed', (topic,), change
    )


def pans(path, mount=MOUNT, topics=None):
    warnings = []
    events = list(sensor_events(Bag(path, warnings.append, topics), mount))
    return [e.pan_rad for e in events if isinstance(e, CameraFrame)], warnings


def joint_message(name, angle, stamp):
    sample = JointSample(stamp, angle)
    return encode.joint_state(FACTORY, sample, PanTiltMount(pan_joint=name, tilt_joint='other'))


def stamp_of(message):
    return message.header.stamp.sec * SECOND + message.header.stamp.nanosec


@pytest.mark.parametrize('name', ['robot1/pan_joint', 'robot1_pan_joint', 'head.pan_joint'])
def test_a_prefixed_joint_is_taken_if_it_is_the_only_one(tmp_path, name):
    def prefixed(topic, message):
        if topic == '/joint_states':
            message.name = [name, 'robot1/tilt_joint']
            yield topic, joint_message('left_wheel_joint', 3.0, stamp_of(message))
        yield topic, message

    found, warnings = pans(rewritten(tmp_path, prefixed))
    np.testing.assert_allclose(found, PANS)
    assert len(warnings) == 1
    assert f'{name} for pan_joint' in warnings[0]


@pytest.mark.parametrize(('robot', 'expected'), [('tilt_joint: tilt_joint', True), ('', False)])
def test_a_tilt_joint_of_the_robot_file_that_no_message_has_is_named(tmp_path, robot, expected):
    def without_tilt(message):
        message.name, message.position = message.name[:1], message.position[:1]
        return message

    file = tmp_path / 'robot.yaml'
    file.write_text(f'pan_axis: {{xyz: [0.0, 0.0, 1.0]}}\n{robot}\n')
    drive = changed(tmp_path, m.JOINTS, without_tilt)
    mount = load_robot(file)
    found, warnings = pans(drive, mount)
    np.testing.assert_allclose(found, PANS)
    named = 'tilt_joint' in ' '.join(warnings)
    checked = [f.line() for f in diagnose(Bag(drive), Calibration.of_mount(mount)).warnings]
    assert named is any('tilt_joint' in line for line in checked) is expected


@pytest.mark.parametrize('turns', [-100_000, 1])
def test_whole_turns_that_a_joint_counts_do_not_matter(tmp_path, turns):
    read = np.array(pans(changed(tmp_path, m.JOINTS, m.added(2.0 * np.pi * turns)))[0])
    assert (np.abs(read) < 4.0 * np.pi).all()
    np.testing.assert_allclose(np.exp(1j * read), np.exp(1j * PANS), atol=1e-6)


def test_the_topic_with_the_pan_joint_is_taken(tmp_path):
    def wheels(topic, message):
        if topic == '/joint_states':
            yield '/head/joint_states', message
            yield topic, joint_message('wheel', 1.0, stamp_of(message))
        else:
            yield topic, message

    assert pans(rewritten(tmp_path, wheels))[0] == pytest.approx(PANS)


def transform(parent, child, rotation, stamp):
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    quaternion = FACTORY('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)
    message = joint_message('x', 0.0, stamp)
    return FACTORY(
        'geometry_msgs/msg/TransformStamped',
        header=FACTORY('std_msgs/msg/Header', stamp=message.header.stamp, frame_id=parent),
        child_frame_id=child,
        transform=FACTORY('geometry_msgs/msg/Transform', rotation=quaternion),
    )


def only_transforms(child, camera_tilt=(0.0, 0.0, 0.0), static=(0.0, 0.0, 0.0)):
    """The pan joint in ``/tf``, behind a fixed joint of the base."""

    def change(topic, message):
        if topic != '/joint_states':
            yield topic, message
            return
        stamp, pan = stamp_of(message), float(message.position[0])
        fixed = rotation_rpy(static)
        turned = fixed.T @ rotation_rpy(camera_tilt) @ rotation_rpy([0.0, 0.0, pan])
        odom = transform('/odom', 'base_link', np.eye(3), stamp)
        pan_tf = transform('/mast', child, turned, stamp)
        mast = transform('base_link', 'mast', fixed, stamp)
        yield '/tf', FACTORY('tf2_msgs/msg/TFMessage', transforms=[odom, pan_tf])
        yield '/tf_static', FACTORY('tf2_msgs/msg/TFMessage', transforms=[mast])

    return change


@pytest.mark.parametrize('child', ['pan_link', 'robot1/pan_link', '/pan_frame'])
def test_the_pan_is_taken_from_transforms_where_it_is_only_there(tmp_path, child):
    found, warnings = pans(rewritten(tmp_path, only_transforms(child)))
    np.testing.assert_allclose(found, PANS, atol=1e-9)
    assert any('the pan is taken from /tf' in warning for warning in warnings)
    assert not any('stamps of 0' in warning for warning in warnings)


def test_frames_of_other_names_are_listed_where_there_are_no_joints(tmp_path):
    warnings = []
    bag = Bag(rewritten(tmp_path, only_transforms('turret')), warnings.append)
    with pytest.raises(LandmarkNavError, match='joint_states is missing'):
        list(sensor_events(bag, MOUNT))
    assert any('turret' in line and '/tf:FRAME' in line for line in warnings)


def test_the_pan_is_that_about_the_axis_of_the_robot(tmp_path):
    camera_tilt, mast = (0.05, -0.1, 0.3), (0.2, 0.0, 1.0)
    mount = PanTiltMount(axis_rpy=camera_tilt)
    path = rewritten(tmp_path, only_transforms('turret', camera_tilt, mast))
    found, _ = pans(path, mount, {'joint_states': '/tf:turret'})
    np.testing.assert_allclose(found, PANS, atol=1e-9)
    bag = Bag(path, topics={'joint_states': '/tf:turret'})
    assert [f.name for f in diagnose(bag, Calibration.of_mount(mount)).errors] == [
        'images content'
    ]
    with pytest.raises(LandmarkNavError, match='has no frame camera: it has base_link, turret'):
        pans(path, mount, {'joint_states': '/tf:camera'})
    sideways = PanTiltMount(axis_rpy=(1.2, 0.0, 0.0))
    with pytest.raises(LandmarkNavError, match='turret does not turn about the pan axis'):
        pans(path, sideways, {'joint_states': '/tf:turret'})


@pytest.mark.parametrize('topic', [m.ODOMETRY, m.JOINTS, m.INFO])
def test_messages_without_stamps_have_the_time_of_recording(tmp_path, topic):
    path = changed(tmp_path, topic, WITHOUT_STAMP)
    found, warnings = pans(path)
    np.testing.assert_allclose(found, PANS)
    assert [w for w in warnings if 'stamps of 0' in w] == warnings
    assert len(warnings) == 1
    warned = [], []
    bag = Bag(path, warned[0].append)
    assert all(
        each.is_unstamped(f'/{topic}') for each in (bag, bag, bag.warning_to(warned[1].append))
    )
    assert [len(each) for each in warned] == [1, 1]
    events = list(sensor_events(bag, MOUNT))
    stamps = [e.stamp_ns for e in events if isinstance(e, OdometrySample)]
    assert stamps == [START + k * SECOND // 20 for k in range(40)]


@pytest.mark.parametrize('spoil', [WITHOUT_STAMP, m.no_number])
def test_a_lone_message_that_cannot_be_used_is_left_out(tmp_path, spoil):
    warnings = []
    path = changed(tmp_path, m.ODOMETRY, m.where(lambda k: k == 7, spoil))
    events = sensor_events(Bag(path, warnings.append), MOUNT)
    assert sum(isinstance(e, OdometrySample) for e in events) == 39
    assert '1 of 40 messages left out' in warnings[0]
    assert '/odom' in warnings[0]


@pytest.mark.parametrize('topic', ['/odom', '/joint_states', '/camera/camera_info'])
def test_messages_of_two_types_on_a_topic_are_refused(tmp_path, topic):
    bag, store = Bag(write_drive(tmp_path / 'drive')), default_typestore()
    with Writer(tmp_path / 'both', version=9, storage_plugin=StoragePlugin.MCAP) as written:
        channels = {}
        for entry in bag.messages():
            messages = [entry.message, *([entry.message.header] if entry.topic == topic else [])]
            for message in messages:
                kind = entry.topic, message.__msgtype__
                if kind not in channels:
                    channels[kind] = written.add_connection(*kind, typestore=store)
                data = store.serialize_cdr(message, message.__msgtype__)
                written.write(channels[kind], entry.stamp_ns, data)
    with pytest.raises(LandmarkNavError, match=topic):
        list(sensor_events(Bag(tmp_path / 'both'), MOUNT))


def test_topics_of_other_names_are_given(tmp_path):
    # A compressed image needs no other name than a raw one.
    topics = {
        'camera/image_raw': '/cam0/image',
        'camera/camera_info': '/cam0/info',
        'odom': '/wheels',
        'joint_states': '/head/angles',
    }
    other = {f'/{name}': given for name, given in topics.items()}
    other['/camera/image_raw/compressed'] = other.pop('/camera/image_raw')
    path = rewritten(tmp_path, lambda t, m: [(t, m)], lambda topic: other.get(topic, topic))
    found, warnings = pans(path, topics=topics)
    np.testing.assert_allclose(found, PANS)
    assert warnings == []
    with pytest.raises(LandmarkNavError, match=r'--topic odom=/gone: not in the bag'):
        pans(path, topics={**topics, 'odom': 'gone'})
    with pytest.raises(LandmarkNavError, match=r'odom is missing.*give --topic odom=/wheels'):
        pans(path, topics={k: v for k, v in topics.items() if k != 'odom'})


def test_a_namespace_is_found_and_reported_once(tmp_path):
    path = rewritten(tmp_path, lambda t, m: [(t, m)], lambda topic: f'//r1{topic}')
    found, warnings = pans(path)
    np.testing.assert_allclose(found, PANS)
    assert sum('is taken for odom' in warning for warning in warnings) == 1


MS = 1_000_000

STEP_MS = 5


@cache
def uneven():
    """Pans of a unit that is sent on ten times a second; it starts, stops and swings."""
    rng, goal, rate = np.random.default_rng(2), 0.0, 0.0
    unit, smooth = PanTiltUnit(PanTiltConfig(encoder_step_rad=0.0, pan_limit_rad=6.3)), []
    for k in range(24_000):
        if k % 300 == 0:
            rate = float(rng.choice([0.0, 0.2, 0.4])) * (-1.0 if goal > 0.0 else 1.0)
        goal += 1e-3 * STEP_MS * rate
        unit.command(goal)
        unit.step(1e-3 * STEP_MS)
        smooth.append(unit.angles_rad[0])
    # Ten times a second faster and slower by a quarter.
    phase = 2.0 * np.pi * 10.0 * 1e-3 * STEP_MS * np.arange(len(smooth))
    return smooth + 0.25 * np.gradient(smooth) / np.diff(phase)[0] * np.sin(phase)


@cache
def sent_on():
    """Pans of a unit that turns here and there, and swings after each stop."""
    rng, pans = np.random.default_rng(1), []
    unit = PanTiltUnit(PanTiltConfig(encoder_step_rad=0.0))
    for k in range(4000):
        if k % 250 == 0:
            unit.command(rng.uniform(-2.0, 2.0))
        unit.step(1e-3 * STEP_MS)
        pans.append(unit.angles_rad[0])
    return np.array(pans)


@pytest.mark.parametrize(
    ('motion', 'period_ms', 'shift_ms', 'floor_rad', 'sigmas', 'beyond'),
    [
        *(
            (uneven, *heard, 2e-4, 5.0, 0.002)
            for heard in ((100, 0), (100, 30), (200, 0), (200, 70))
        ),
        *((sent_on, period_ms, 0, 1e-4, 3.0, 0.01) for period_ms in (10, 20, 50)),
    ],
)
def test_what_joint_states_do_not_show_of_a_motion_is_claimed(
    motion, period_ms, shift_ms, floor_rad, sigmas, beyond
):
    true, every, first = motion(), period_ms // STEP_MS, shift_ms // STEP_MS
    known = range(first, len(true), every)
    history = JointHistory([JointSample(k * STEP_MS * MS, true[k]) for k in known])
    between = range(first + every, len(true) - 3 * every)
    found = [history.at(k * STEP_MS * MS) for k in between]
    sigma = np.array([sample.pan_sigma_rad for sample in found])
    assert not sigma[::every].any()
    off = [sample.pan_rad for sample in found] - true[first + every : len(true) - 3 * every]
    normalized = (off / np.hypot(sigma, floor_rad))[np.arange(len(off)) % every > 0]
    assert np.sqrt(np.mean(np.square(normalized))) < 1.0
    assert np.mean(np.abs(normalized) > sigmas) < beyond


STORE = default_typestore()
CAMERA = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
STAMP = 3 * 10**9
MOUNTS = [
    PanTiltMount((0.1, -0.05, 1.2), (0.02, -0.03, 0.4), (0.03, 0.01, 0.02)),
    # Hangs upside down, and so does the camera on it.
    PanTiltMount((0.0, 0.0, 1.0), (np.pi, 0.0, 0.0), (0.02, 0.0, 0.0), camera_roll_rad=np.pi),
]


def taken(transforms, topic, message):
    """Transforms that follow from a message, which can be written into a bag."""
    data = bytes(STORE.serialize_cdr(message, message.__msgtype__))
    found = list(transforms.of(topic, data))
    for _, made in found:
        STORE.serialize_cdr(made, made.__msgtype__)
    return found


def matrix(transform):
    t, q = transform.translation, transform.rotation
    whole = np.eye(4)
    whole[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    whole[:3, 3] = t.x, t.y, t.z
    return whole


@pytest.mark.parametrize('mount', MOUNTS)
def test_the_tree_leads_from_the_map_to_the_camera(mount):
    transforms = RobotTransforms(mount)
    odometry, fused = np.array([1.0, 0.5, 0.3]), np.array([2.0, -1.0, 2.9])
    joints = JointSample(STAMP, 0.7, -0.2)
    messages = {
        'camera/camera_info': encode.camera_info(FACTORY, CAMERA, STAMP, 'optical'),
        'odom': encode.odometry(FACTORY, OdometrySample(STAMP, odometry)),
        'odometry/fused': encode.odometry(
            FACTORY, OdometrySample(STAMP, fused), np.eye(3), frame_id='map'
        ),
        'joint_states': encode.joint_state(FACTORY, joints, mount),
        'detections': encode.header(FACTORY, 0, ''),
    }
    found = [one for item in messages.items() for one in taken(transforms, *item)]
    assert {topic for topic, _ in found} == {'tf', 'tf_static'}
    tree = {t.child_frame_id: t for _, message in found for t in message.transforms}
    pose, frame, passed = np.eye(4), 'optical', []
    while frame in tree:
        pose = matrix(tree[frame].transform) @ pose
        frame = tree[frame].header.frame_id
        passed.append(frame)
    assert passed == ['tilt_link', 'pan_link', 'base_link', 'odom', 'map']
    rotation, center = mount.camera_pose_map(fused, joints.pan_rad, joints.tilt_rad)
    np.testing.assert_allclose(pose[:3, :3], rotation, atol=1e-9)
    np.testing.assert_allclose(pose[:3, 3], center, atol=1e-9)
