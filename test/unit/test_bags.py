from __future__ import annotations

import re

import cv2
from mcap.writer import Writer as RawWriter
import numpy as np
import pytest
import yaml

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import decode, encode
from landmark_nav.messages.factory import rosbag_factory
from landmark_nav.storage.bags import (
    Bag,
    BagWriter,
    read_bag,
    read_sweep_folder,
    read_sweeps,
    sensor_events,
)
from landmark_nav.storage.bags.topics import relative_name
from landmark_nav.types import (
    CameraFrame,
    JointSample,
    OdometrySample,
    PoseEstimate,
)

FACTORY = rosbag_factory()
MOUNT = PanTiltMount()
CAMERA = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
SECOND = 1_000_000_000
START = 1000 * SECOND


def picture(value):
    return np.full((48, 64), value % 256, np.uint8)


def odometry(stamp, pose, **frames):
    return encode.odometry(FACTORY, OdometrySample(stamp, np.asarray(pose, float)), **frames)


@pytest.fixture
def odometry_bag(tmp_path):
    path = tmp_path / 'odometry'
    with BagWriter(path) as bag:
        for k in range(200):
            stamp = START + k * SECOND // 20
            bag.write('odom', odometry(stamp, [0.01 * k, 0.0, 0.0]), stamp)
            bag.write('/note', FACTORY('std_msgs/msg/String', data='x' * 12000), stamp)
    return path


def write_sweep(bag, start, pans, *, keep=None, trajectory=True, topic='sweep/image', step=SECOND):
    samples = [JointSample(start + k * step, float(p)) for k, p in enumerate(pans)]
    for k, sample in enumerate(samples):
        stamp = sample.stamp_ns
        if keep is None or keep(k):
            bag.write(topic, encode.image(FACTORY, picture(k), stamp, 'cam'), stamp)
            info = encode.camera_info(FACTORY, CAMERA, stamp, 'cam')
            bag.write('sweep/camera_info', info, stamp)
        bag.write('joint_states', encode.joint_state(FACTORY, sample, MOUNT), stamp)
    if trajectory:
        end = samples[-1].stamp_ns
        message = encode.sweep_trajectory(FACTORY, samples, MOUNT)
        bag.write('sweep/trajectory', message, end)


def full_turn(count=24):
    return -np.pi + 2 * np.pi / count * np.arange(count)


# Container and reader


def test_bag_is_a_rosbag2_folder_and_comes_back_in_order(odometry_bag):
    metadata = yaml.safe_load((odometry_bag / 'metadata.yaml').read_text())
    information = metadata['rosbag2_bagfile_information']
    assert information['storage_identifier'] == 'mcap'
    assert information['relative_file_paths'] == ['odometry.mcap']
    assert sorted(p.name for p in odometry_bag.iterdir()) == ['metadata.yaml', 'odometry.mcap']
    bag = Bag(odometry_bag)
    assert bag.counts == {'/odom': 200, '/note': 200}
    assert bag.duration_s == pytest.approx(9.95)
    entries = list(bag.messages(['/odom']))
    assert [e.stamp_ns for e in entries] == sorted(e.stamp_ns for e in entries)
    assert decode.odometry(entries[7].message).pose_odom_base[0] == pytest.approx(0.07)
    assert entries[7].type_name == 'nav_msgs/msg/Odometry'


def test_lone_file_and_serialised_copy_hold_the_same(odometry_bag, tmp_path):
    with BagWriter(tmp_path / 'copy') as copy:
        for entry in read_bag(odometry_bag / 'odometry.mcap'):
            copy.write_serialized(entry.topic, entry.type_name, entry.data, entry.stamp_ns)
    first, second = list(read_bag(odometry_bag)), list(read_bag(tmp_path / 'copy'))
    assert [(e.topic, e.stamp_ns, e.data) for e in first] == [
        (e.topic, e.stamp_ns, e.data) for e in second
    ]


@pytest.mark.parametrize('share', [0.02, 0.3, 0.77, 0.995])
def test_truncated_file_is_read_up_to_the_break_and_says_so(odometry_bag, share):
    path = odometry_bag / 'odometry.mcap'
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    warnings = []
    bag = Bag(odometry_bag, warnings.append)
    entries = list(bag.messages())
    assert not bag.complete
    assert len(warnings) == 1
    assert f'{len(entries)} messages' in warnings[0]
    assert len(entries) == pytest.approx(400 * share, abs=40 * share + 3)
    assert [e.message.data for e in entries if e.topic == '/note'][-1] == 'x' * 12000


def test_lost_metadata_is_told_and_done_without(odometry_bag):
    (odometry_bag / 'metadata.yaml').unlink()
    warnings = []
    assert Bag(odometry_bag, warnings.append).counts['/odom'] == 200
    assert 'metadata.yaml is missing' in warnings[0]


def test_files_of_a_split_bag_are_merged(odometry_bag, tmp_path):
    with BagWriter(tmp_path / 'later') as later:
        stamp = START + 60 * SECOND
        later.write('odom', odometry(stamp, [9.0, 0.0, 0.0]), stamp)
    (tmp_path / 'later' / 'later.mcap').rename(odometry_bag / 'later.mcap')
    path = odometry_bag / 'metadata.yaml'
    metadata = yaml.safe_load(path.read_text())
    files = metadata['rosbag2_bagfile_information']['relative_file_paths']
    files.insert(0, 'later.mcap')
    path.write_text(yaml.safe_dump(metadata))
    bag = Bag(odometry_bag)
    assert bag.counts['/odom'] == 201
    assert list(bag.messages(['/odom']))[-1].stamp_ns == stamp
    files.append('gone.mcap')
    path.write_text(yaml.safe_dump(metadata))
    with pytest.raises(LandmarkNavError, match=r'gone\.mcap'):
        Bag(odometry_bag)


def test_what_is_no_bag_is_refused_with_what_it_is(tmp_path):
    def refused(path, match):
        with pytest.raises(LandmarkNavError, match=match) as error:
            Bag(path)
        assert '\n' not in str(error.value)

    refused(tmp_path / 'nowhere', 'no bag there')
    refused(tmp_path, 'folder without metadata')
    text = tmp_path / 'notes.mcap'
    text.write_text('hello world')
    refused(text, r'not an MCAP file \(it begins with')
    (tmp_path / 'empty.mcap').write_bytes(b'')
    refused(tmp_path / 'empty.mcap', 'empty')
    (tmp_path / 'old.bag').write_bytes(b'#ROSBAG V2.0\n')
    refused(tmp_path / 'old.bag', 'ROS 1 bag: convert it with `rosbags-convert')
    sqlite = tmp_path / 'sqlite'
    sqlite.mkdir()
    (sqlite / 'a.db3').write_bytes(b'SQLite format 3')
    refused(sqlite, 'sqlite3 bag: convert it')
    refused(sqlite / 'a.db3', 'sqlite3 bag: convert it')
    information = {'storage_identifier': 'sqlite3', 'relative_file_paths': ['a.db3']}
    metadata = sqlite / 'metadata.yaml'
    metadata.write_text(yaml.safe_dump({'rosbag2_bagfile_information': information}))
    refused(sqlite, 'sqlite3 bag: convert it')
    information.update(storage_identifier='mcap', compression_mode='FILE')
    metadata.write_text(yaml.safe_dump({'rosbag2_bagfile_information': information}))
    refused(sqlite, 'compressed by file')
    metadata.write_text('other: 1')
    refused(sqlite, 'not the description')
    refused(metadata, 'give the folder')


def test_foreign_encodings_matter_only_if_they_are_asked_for(tmp_path):
    path = tmp_path / 'mixed.mcap'
    with path.open('wb') as stream:
        writer = RawWriter(stream)
        writer.start()
        schema = writer.register_schema('Thing', 'jsonschema', b'{}')
        channel = writer.register_channel('/thing', 'json', schema)
        text = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data\n')
        other = writer.register_channel('/text', 'cdr', text)
        writer.add_message(channel, 1, b'{}', 1)
        writer.add_message(other, 2, b'\0\1\0\0\3\0\0\0hi\0', 2)
        writer.add_message(other, 3, b'\0\1\0\0\xff\0\0\0hi\0', 3)
        writer.finish()
    bag = Bag(path)
    with pytest.raises(LandmarkNavError, match='written as json with jsonschema schema'):
        list(bag.messages())
    good, bad = bag.messages(['/text'])
    assert good.message.data == 'hi'
    with pytest.raises(LandmarkNavError, match=r'/text is not a std_msgs/msg/String'):
        _ = bad.message


def test_types_come_from_the_bag_itself(tmp_path):
    path = tmp_path / 'own.mcap'
    with path.open('wb') as stream:
        writer = RawWriter(stream)
        writer.start()
        schema = writer.register_schema('my_msgs/msg/Pair', 'ros2msg', b'int32 a\nint32 b\n')
        channel = writer.register_channel('/pair', 'cdr', schema)
        writer.add_message(channel, 1, b'\0\1\0\0\7\0\0\0\x09\0\0\0', 1)
        writer.finish()
    (entry,) = read_bag(path)
    assert (entry.message.a, entry.message.b) == (7, 9)


def test_damage_anywhere_is_told_in_one_line_or_does_not_matter(tmp_path):
    whole = (write_drive(tmp_path / 'drive') / 'drive.mcap').read_bytes()
    rng = np.random.default_rng(0)
    path = tmp_path / 'damaged.mcap'
    complaints = []
    for _ in range(20):
        bytes_ = np.frombuffer(whole, np.uint8).copy()
        near_end = len(bytes_) - rng.integers(1, 1500, 3)
        places = np.where(rng.random(3) < 0.4, near_end, rng.integers(8, len(bytes_), 3))
        bytes_[places] = rng.integers(0, 256, 3)
        path.write_bytes(bytes_.tobytes())
        try:
            list(sensor_events(Bag(path), MOUNT))
        except LandmarkNavError as error:
            complaints.append(str(error))
    assert 0 < len(complaints) < 20
    assert not any('\n' in complaint for complaint in complaints)


def test_nothing_half_written_is_left(tmp_path):
    def interrupted():
        with BagWriter(tmp_path / 'bag') as bag:
            bag.write('odom', odometry(START, [0, 0, 0]), START)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / 'bag').mkdir()
    with pytest.raises(LandmarkNavError, match='exists already'):
        BagWriter(tmp_path / 'bag')


# Topics


@pytest.mark.parametrize(
    ('topic', 'name'),
    [
        ('/odom', 'odom'),
        ('/ground_truth/odom', 'ground_truth/odom'),
        ('/robot1/odom', 'odom'),
        ('/robot1/ground_truth/odom', 'ground_truth/odom'),
        ('/a/b/camera/image_raw/compressed', 'camera/image_raw/compressed'),
        ('/radodom', 'radodom'),
    ],
)
def test_contract_names_are_found_under_any_namespace(topic, name):
    assert relative_name(topic) == name


def test_missing_ambiguous_and_wrong_topics_are_told(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        for name in ('/ground_truth/odom', '/r1/odom', '/r2/odom'):
            bag.write(name, odometry(START, [0, 0, 0]), START)
        bag.write('joint_states', odometry(START, [0, 0, 0]), START)
    bag = Bag(tmp_path / 'bag')
    assert bag.find('ground_truth/odom') == '/ground_truth/odom'
    with pytest.raises(LandmarkNavError, match=r'several topics could be odom \(/r1/odom, /r2'):
        bag.find('odom')
    with pytest.raises(LandmarkNavError, match=r'camera_info is missing.*/r1/odom \(1\)'):
        bag.require('camera/camera_info')
    with pytest.raises(LandmarkNavError, match='nav_msgs/msg/Odometry, not sensor_msgs'):
        bag.find('joint_states')


# Drives


def write_drive(path, *, frames=10, damaged=(), info=True, bad_odometry=None, late_joints=False):
    """Pan turns at 0.3 rad/s; joint states at 20 Hz, pictures at 5 Hz between two of them."""
    with BagWriter(path) as bag:
        for k in range(frames * 4):
            stamp = START + k * 50_000_000
            x = np.nan if k == bad_odometry else 0.01 * k
            bag.write('odom', odometry(stamp, [x, 0.0, 0.0]), stamp)
            joints_stamp = stamp + (9 * SECOND if late_joints else 0)
            sample = JointSample(joints_stamp, 0.3 * k * 0.05)
            bag.write('joint_states', encode.joint_state(FACTORY, sample, MOUNT), stamp)
            bag.write('ground_truth/odom', odometry(stamp, [1.0, 2.0, 0.0], frame_id='map'), stamp)
            if k % 4 == 0:
                shot = stamp + 20_000_000
                message = encode.compressed_image(FACTORY, picture(k), shot, 'cam')
                if k // 4 in damaged:
                    message.data = message.data[:30]
                bag.write('camera/image_raw/compressed', message, shot)
                if info:
                    calibration = encode.camera_info(FACTORY, CAMERA, shot, 'cam')
                    bag.write('camera/camera_info', calibration, shot)
    return path


def test_frames_carry_the_pan_of_their_own_stamp(tmp_path):
    events = list(sensor_events(Bag(write_drive(tmp_path / 'drive')), MOUNT))
    frames = [e for e in events if isinstance(e, CameraFrame)]
    assert len(frames) == 10
    for k, frame in enumerate(frames[:-1]):
        assert frame.stamp_ns == START + k * 200_000_000 + 20_000_000
        assert frame.pan_rad == pytest.approx(0.3 * (0.2 * k + 0.02))
        assert frame.camera == CAMERA
    assert sum(isinstance(e, OdometrySample) for e in events) == 40
    assert sum(isinstance(e, JointSample) for e in events) == 40
    truth = [e for e in events if isinstance(e, PoseEstimate)]
    assert len(truth) == 40
    np.testing.assert_allclose(truth[0].pose, [1.0, 2.0, 0.0])


def test_raw_pictures_are_preferred_to_compressed_ones(tmp_path):
    path = write_drive(tmp_path / 'drive')
    with BagWriter(tmp_path / 'both') as both:
        for entry in read_bag(path):
            both.write_serialized(entry.topic, entry.type_name, entry.data, entry.stamp_ns)
        stamp = START + SECOND
        both.write('camera/image_raw', encode.image(FACTORY, picture(9), stamp, ''), stamp)
    frames = [
        e for e in sensor_events(Bag(tmp_path / 'both'), MOUNT) if isinstance(e, CameraFrame)
    ]
    assert [f.stamp_ns for f in frames] == [stamp]


def test_a_damaged_picture_is_left_out_and_told(tmp_path):
    warnings = []
    bag = Bag(write_drive(tmp_path / 'drive', damaged=(2, 5)), warnings.append)
    frames = [e for e in sensor_events(bag, MOUNT) if isinstance(e, CameraFrame)]
    assert len(frames) == 8
    assert len(warnings) == 1
    assert '2 of 10 pictures left out' in warnings[0]
    assert 'does not decode' in warnings[0]


@pytest.mark.parametrize(
    ('drive', 'match'),
    [
        ({'damaged': range(10)}, 'does not decode'),
        ({'info': False}, 'camera/camera_info is missing'),
        ({'bad_odometry': 7}, r'/odom: odometry position at 1000\.350 s .*nan'),
        ({'late_joints': True}, 'no joint state near it'),
    ],
)
def test_drives_that_cannot_be_used_are_refused(tmp_path, drive, match):
    bag = Bag(write_drive(tmp_path / 'drive', **drive))
    with pytest.raises(LandmarkNavError, match=match):
        list(sensor_events(bag, MOUNT))


# Sweeps


def test_sweeps_come_back_with_the_measured_pans(tmp_path):
    with BagWriter(tmp_path / 'learn') as bag:
        for number, start in enumerate((START, START + 60 * SECOND)):
            write_sweep(bag, start, full_turn())
            estimate = PoseEstimate(start, np.array([number, 2.0, 0.5]), np.eye(3))
            bag.write('sweep/pose', encode.pose(FACTORY, estimate), start)
    sweeps = list(read_sweeps(Bag(tmp_path / 'learn'), MOUNT))
    assert [s.stamp_ns for s in sweeps] == [START, START + 60 * SECOND]
    for number, sweep in enumerate(sweeps):
        np.testing.assert_array_equal([f.pan_rad for f in sweep.frames], full_turn())
        assert [f.image[0, 0] for f in sweep.frames] == list(range(24))
        assert sweep.pose_map_base.pose[0] == number


@pytest.mark.parametrize(
    ('lost', 'frames', 'words'),
    [
        # The pictures are 56 degrees wide and 15 apart.
        ([8], 23, r'1 frame is missing, at pan -60 deg; their neighbours see it all'),
        (range(8, 13), 19, r'at pan -60, .*, 0 deg; nothing is seen from pan -47 to -13 deg'),
    ],
)
def test_a_sweep_with_missing_frames_is_used_and_the_gap_named(tmp_path, lost, frames, words):
    with BagWriter(tmp_path / 'hole') as bag:
        write_sweep(bag, START, full_turn(), keep=lambda k: k not in lost)
    warnings = []
    (sweep,) = read_sweeps(Bag(tmp_path / 'hole', warnings.append), MOUNT)
    assert len(sweep.frames) == frames
    assert re.search(words, warnings[0])


def test_a_sweep_without_any_frame_is_refused(tmp_path):
    with BagWriter(tmp_path / 'none') as bag:
        write_sweep(bag, START, full_turn())
        write_sweep(bag, START + 60 * SECOND, full_turn(), keep=lambda k: False)
    with pytest.raises(LandmarkNavError, match='has no frames'):
        list(read_sweeps(Bag(tmp_path / 'none'), MOUNT))


def test_a_gap_that_no_trajectory_tells_of_is_found_too(tmp_path):
    with BagWriter(tmp_path / 'gap') as bag:
        write_sweep(bag, START, np.delete(full_turn(), slice(8, 14)))
    warnings = []
    list(read_sweeps(Bag(tmp_path / 'gap', warnings.append), MOUNT))
    assert 'nothing is seen from pan -47 to 2 deg' in warnings[0]


def test_a_joint_that_cannot_turn_fully_is_lived_with(tmp_path):
    with BagWriter(tmp_path / 'limited') as bag:
        write_sweep(bag, START, np.radians(np.arange(-120, 121, 15)))
    warnings = []
    (sweep,) = read_sweeps(Bag(tmp_path / 'limited', warnings.append), MOUNT)
    assert len(sweep.frames) == 17
    assert 'nothing is seen from pan 148 to 212 deg' in warnings[0]


def test_without_trajectory_the_joint_states_tell(tmp_path):
    with BagWriter(tmp_path / 'learn') as bag:
        write_sweep(bag, START, full_turn(), trajectory=False)
        write_sweep(bag, START + 90 * SECOND, full_turn(), trajectory=False)
    warnings = []
    sweeps = list(read_sweeps(Bag(tmp_path / 'learn', warnings.append), MOUNT))
    assert [len(s.frames) for s in sweeps] == [24, 24]
    np.testing.assert_allclose([f.pan_rad for f in sweeps[1].frames], full_turn())
    assert 'joint_states' in warnings[0]


def test_a_sweep_that_was_given_up_is_left_out(tmp_path):
    with BagWriter(tmp_path / 'learn') as bag:
        write_sweep(bag, START, full_turn()[:7], trajectory=False)
        write_sweep(bag, START + 90 * SECOND, full_turn())
    warnings = []
    (sweep,) = read_sweeps(Bag(tmp_path / 'learn', warnings.append), MOUNT)
    assert len(sweep.frames) == 24
    assert '7 frames belong to no sweep/trajectory' in warnings[0]


def test_recording_cut_off_in_a_sweep_keeps_the_whole_ones(tmp_path):
    folder = tmp_path / 'learn'
    with BagWriter(folder) as bag:
        write_sweep(bag, START, full_turn())
        write_sweep(bag, START + 60 * SECOND, full_turn())
    path = folder / 'learn.mcap'
    whole = path.read_bytes()
    needle = whole.rindex(picture(9).tobytes())
    path.write_bytes(whole[: needle + 100])
    warnings = []
    (sweep,) = read_sweeps(Bag(folder, warnings.append), MOUNT)
    assert sweep.stamp_ns == START
    assert any('was cut off' in w for w in warnings)


# Folders


def test_a_folder_of_pictures_is_a_sweep(tmp_path):
    rows = ['file,pan_rad,focal_px,width,height']
    for k, pan in enumerate(full_turn(6)):
        cv2.imwrite(str(tmp_path / f'{k}.png'), picture(k * 10))
        rows.append(f'{k}.png,{pan},{50 + k},64,48')
    (tmp_path / 'frames.csv').write_text('\n'.join(rows))
    sweep = read_sweep_folder(tmp_path)
    np.testing.assert_allclose([f.pan_rad for f in sweep.frames], full_turn(6))
    assert sweep.frames[3].camera == CameraModel(64, 48, 53.0, 53.0, 31.5, 23.5)
    assert sweep.frames[3].image[0, 0, 0] == 30

    def refused(line, match):
        (tmp_path / 'frames.csv').write_text('\n'.join([*rows, line]))
        with pytest.raises(LandmarkNavError, match=match):
            read_sweep_folder(tmp_path)

    refused('gone.png,0.1,50,64,48', r'line 8: gone\.png is not there')
    refused('1.png,abc,50,64,48', 'line 8: could not convert')
    refused('1.png,nan,50,64,48', 'line 8: pan_rad is nan')
    refused('1.png,0.1,50,65,48', 'line 8: 1.png is 64 x 48, not 65 x 48')
    refused('1.png,0.1,-50,64,48', 'line 8: .*not a calibrated camera')
    (tmp_path / 'frames.csv').write_text('file,pan\n1.png,0')
    with pytest.raises(LandmarkNavError, match='lacks pan_rad, focal_px, width, height'):
        read_sweep_folder(tmp_path)


# Data nobody here drew


def test_study_bags_are_read(shared_data):
    learn = list(read_sweeps(Bag(shared_data / 'study' / 'learn'), MOUNT))
    assert [len(s.frames) for s in learn] == [72, 72]
    assert learn[0].frames[0].image.shape == (512, 512, 3)
    bag = Bag(shared_data / 'study' / 'drive')
    assert bag.counts['/camera/image_raw/compressed'] == 184


@pytest.mark.parametrize('name', ['grail', 'parrington'])
def test_photographed_sweeps_are_read(shared_data, name):
    assert len(read_sweep_folder(shared_data / 'pan_sweeps' / name).frames) == 18
