"""Joints, frames, stamps and topics as robots publish them."""

from bag_writers import FACTORY, MOUNT, SECOND, START, write_drive
import numpy as np
import pytest

from landmark_nav.calibration import Calibration
from landmark_nav.cli.main import main
from landmark_nav.diagnosis import diagnose
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import rotation_rpy
from landmark_nav.messages import encode
from landmark_nav.messages.decode import JointNames
from landmark_nav.storage.bags import Bag, BagWriter, sensor_events
from landmark_nav.types import CameraFrame, JointSample, OdometrySample

PANS = 0.3 * (0.2 * np.arange(10) + 0.02)


def rewritten(tmp_path, change, topics=lambda topic: topic):
    """A drive with each message changed; `change` may leave one out or give several."""
    drive = write_drive(tmp_path / 'drive')
    with BagWriter(tmp_path / 'changed') as bag:
        for entry in Bag(drive).messages():
            for topic, message in change(entry.topic, entry.message):
                bag.write(topics(topic), message, entry.stamp_ns)
    return tmp_path / 'changed'


def with_joints(tmp_path, change):
    """A drive whose joint states were changed in place."""

    def changed(topic, message):
        if topic == '/joint_states':
            change(message)
        yield topic, message

    return rewritten(tmp_path, changed)


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


@pytest.mark.parametrize(
    ('field', 'value', 'reported'),
    [
        ('position', np.array([0.1, np.nan]), f'of {MOUNT.tilt_joint} .* is nan'),
        ('name', ['shoulder', 'elbow'], 'elbow, shoulder arrive, not pan_joint'),
    ],
)
def test_joints_without_an_angle_or_of_other_names_are_named(tmp_path, field, value, reported):
    with pytest.raises(LandmarkNavError, match=reported):
        pans(with_joints(tmp_path, lambda message: setattr(message, field, value)))


@pytest.mark.parametrize('turns', [-100_000, -1, 0, 1, 100_000])
def test_whole_turns_that_a_joint_counts_do_not_matter(tmp_path, turns):
    def count(message):
        message.position = np.add(message.position, [2.0 * np.pi * turns, 0.0])

    read = np.array(pans(with_joints(tmp_path, count))[0])
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


def test_names_of_joints_are_kept_in_bounded_memory():
    names = JointNames(MOUNT)
    for k in range(10_000):
        names.add([f'joint{k}'])
    assert not names.pan_arrives
    assert len(names.missing) < 200


def transform(parent, child, rotation, stamp):
    x, y, z, w = rotation
    quaternion = FACTORY('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)
    message = joint_message('x', 0.0, stamp)
    return FACTORY(
        'geometry_msgs/msg/TransformStamped',
        header=FACTORY('std_msgs/msg/Header', stamp=message.header.stamp, frame_id=parent),
        child_frame_id=child,
        transform=FACTORY('geometry_msgs/msg/Transform', rotation=quaternion),
    )


def quaternion_of(matrix):
    w = 0.5 * np.sqrt(1.0 + np.trace(matrix))
    x, y, z = (matrix[k, j] - matrix[j, k] for j, k in ((1, 2), (2, 0), (0, 1)))
    return [*(float(part / (4.0 * w)) for part in (x, y, z)), float(w)]


def only_transforms(child, camera_tilt=(0.0, 0.0, 0.0), static=(0.0, 0.0, 0.0)):
    """The pan joint in ``/tf``, behind a fixed joint of the base."""

    def change(topic, message):
        if topic != '/joint_states':
            yield topic, message
            return
        stamp, pan = stamp_of(message), float(message.position[0])
        fixed = rotation_rpy(static)
        turned = fixed.T @ rotation_rpy(camera_tilt) @ rotation_rpy([0.0, 0.0, pan])
        odom = transform('/odom', 'base_link', [0.0, 0.0, 0.0, 1.0], stamp)
        pan_tf = transform('/mast', child, quaternion_of(turned), stamp)
        mast = transform('base_link', 'mast', quaternion_of(fixed), stamp)
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


@pytest.mark.parametrize('topic', ['/odom', '/joint_states', '/camera/camera_info'])
def test_messages_without_stamps_have_the_time_of_recording(tmp_path, topic):
    def unstamped(name, message):
        if name == topic:
            message.header.stamp.sec = message.header.stamp.nanosec = 0
        yield name, message

    path = rewritten(tmp_path, unstamped)
    found, warnings = pans(path)
    np.testing.assert_allclose(found, PANS)
    assert [w for w in warnings if 'stamps of 0' in w] == warnings
    assert len(warnings) == 1
    warned = [], []
    bag = Bag(path, warned[0].append)
    assert all(each.is_unstamped(topic) for each in (bag, bag, bag.warning_to(warned[1].append)))
    assert [len(each) for each in warned] == [1, 1]
    events = list(sensor_events(bag, MOUNT))
    stamps = [e.stamp_ns for e in events if isinstance(e, OdometrySample)]
    assert stamps == [START + k * SECOND // 20 for k in range(40)]


def without_stamp(message):
    message.header.stamp.sec = message.header.stamp.nanosec = 0


def without_number(message):
    message.pose.pose.position.x = np.nan


@pytest.mark.parametrize('spoil', [without_stamp, without_number])
def test_a_lone_message_that_cannot_be_used_is_left_out(tmp_path, spoil):
    seen = iter(range(1000))

    def changed(topic, message):
        if topic == '/odom' and next(seen) == 7:
            spoil(message)
        yield topic, message

    warnings = []
    bag = Bag(rewritten(tmp_path, changed), warnings.append)
    events = list(sensor_events(bag, MOUNT))
    assert sum(isinstance(e, OdometrySample) for e in events) == 39
    assert '1 of 40 messages left out' in warnings[0]
    assert '/odom' in warnings[0]


def test_topics_of_other_names_are_given(tmp_path):
    other = {
        '/camera/image_raw/compressed': '/cam0/image',
        '/camera/camera_info': '/cam0/info',
        '/odom': '/wheels',
        '/joint_states': '/head/angles',
    }
    path = rewritten(tmp_path, lambda t, m: [(t, m)], lambda topic: other.get(topic, topic))
    # A compressed image needs no other name than a raw one.
    names = ('camera/image_raw', 'camera/camera_info', 'odom', 'joint_states')
    topics = dict(zip(names, other.values(), strict=True))
    found, warnings = pans(path, topics=topics)
    np.testing.assert_allclose(found, PANS)
    assert warnings == []
    with pytest.raises(LandmarkNavError, match=r'--topic odom=/gone: not in the bag; '):
        pans(path, topics={**topics, 'odom': 'gone'})
    with pytest.raises(LandmarkNavError, match=r'odom is missing.*give --topic odom=/wheels'):
        pans(path, topics={k: v for k, v in topics.items() if k != 'odom'})


def test_a_namespace_is_found_and_reported_once(tmp_path):
    path = rewritten(tmp_path, lambda t, m: [(t, m)], lambda topic: f'//r1{topic}')
    found, warnings = pans(path)
    np.testing.assert_allclose(found, PANS)
    assert sum('is taken for odom' in warning for warning in warnings) == 1


@pytest.mark.parametrize('value', ['odom', 'odom=', 'wheels=/odom', '=/odom'])
def test_a_topic_that_is_no_name_of_ours_is_wrong_usage(capsys, value):
    assert (
        main(['learn', 'bag', '--topic', value, '--robot', 'x', '--room', 'y', '--out', 'z']) == 2
    )
    assert 'is not NAME=TOPIC' in capsys.readouterr().err
