"""Bags are written and read as rosbag2 folders, and say what is wrong with them."""

from __future__ import annotations

from bag_writers import FACTORY, foreign_bag, MOUNT, odometry, SECOND, START, write_drive
import numpy as np
import pytest
import yaml

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages import decode, encode
from landmark_nav.storage.bags import Bag, BagWriter, sensor_events
from landmark_nav.storage.bags.topics import relative_name


@pytest.fixture
def odometry_bag(tmp_path):
    path = tmp_path / 'odometry'
    with BagWriter(path) as bag:
        for k in range(200):
            stamp = START + k * SECOND // 20
            bag.write('odom', odometry(stamp, [0.01 * k, 0.0, 0.0]), stamp)
            bag.write('/note', FACTORY('std_msgs/msg/String', data='x' * 12000), stamp)
    return path


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
        for entry in Bag(odometry_bag / 'odometry.mcap').messages():
            copy.write_serialized(entry.topic, entry.type_name, entry.data, entry.stamp_ns)
    first, second = (list(Bag(k).messages()) for k in (odometry_bag, tmp_path / 'copy'))
    assert [(e.topic, e.stamp_ns, e.data) for e in first] == [
        (e.topic, e.stamp_ns, e.data) for e in second
    ]


@pytest.mark.parametrize('share', [0.02, 0.3, 0.77, 0.995])
def test_truncated_file_is_read_up_to_the_break_and_reports_it(odometry_bag, share):
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


def test_lost_metadata_is_reported_and_done_without(odometry_bag):
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
    refused(text, r'not a bag \(it begins with')
    (tmp_path / 'empty.mcap').write_bytes(b'')
    refused(tmp_path / 'empty.mcap', 'empty')
    for name, head in (('old.bag', b'#ROSBAG V2.0\n'), ('a.db3', b'SQLite format 3\0')):
        (tmp_path / name).write_bytes(head)
        refused(tmp_path / name, f'{name}: cannot be read')
    rosbag2 = tmp_path / 'rosbag2'
    rosbag2.mkdir()
    metadata = rosbag2 / 'metadata.yaml'
    for named in (None, 'a.mcap', [], ['.'], ['..'], [7], ['gone.mcap']):
        information = {'storage_identifier': 'mcap', 'relative_file_paths': named}
        metadata.write_text(yaml.safe_dump({'rosbag2_bagfile_information': information}))
        refused(rosbag2, 'which is not there')
    metadata.write_text('other: 1')
    refused(rosbag2, 'not the description')
    refused(metadata, 'give the folder')


def test_foreign_encodings_matter_only_if_they_are_asked_for(tmp_path):
    path = tmp_path / 'mixed.mcap'
    with foreign_bag(path) as add:
        add('/thing', ('Thing', 'jsonschema', b'{}'), 'json', [b'{}'])
        text = ('std_msgs/msg/String', 'ros2msg', b'string data\n')
        good, bad = b'\0\1\0\0\3\0\0\0hi\0', b'\0\1\0\0\xff\0\0\0hi\0'
        add('/text', text, 'cdr', [good, bad])
    bag = Bag(path)
    with pytest.raises(LandmarkNavError, match='written as json with jsonschema schema'):
        list(bag.messages())
    good, bad = bag.messages(['/text'])
    assert good.message.data == 'hi'
    with pytest.raises(LandmarkNavError, match=r'/text is not a std_msgs/msg/String'):
        _ = bad.message


def test_types_come_from_the_bag_itself(tmp_path):
    path = tmp_path / 'own.mcap'
    with foreign_bag(path) as add:
        pair = ('my_msgs/msg/Pair', 'ros2msg', b'int32 a\nint32 b\n')
        add('/pair', pair, 'cdr', [b'\0\1\0\0\7\0\0\0\x09\0\0\0'])
    (entry,) = Bag(path).messages()
    assert (entry.message.a, entry.message.b) == (7, 9)


def test_damage_anywhere_is_reported_in_one_line_or_does_not_matter(tmp_path):
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


def test_missing_ambiguous_and_wrong_topics_are_reported(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        for name in ('/ground_truth/odom', '/r1/odom', '/r2/odom'):
            bag.write(name, odometry(START, [0, 0, 0]), START)
        bag.write('joint_states', odometry(START, [0, 0, 0]), START)
    bag = Bag(tmp_path / 'bag')
    assert bag.find('ground_truth/odom') == '/ground_truth/odom'
    with pytest.raises(
        LandmarkNavError, match=r'several topics could be odom \(/r1/odom, /r2'
    ) as reported:
        bag.find('odom')
    assert '--topic odom=/r1/odom' in str(reported.value)
    with pytest.raises(LandmarkNavError, match=r'camera_info is missing.*/r1/odom \(1\)'):
        bag.require('camera/camera_info')
    with pytest.raises(LandmarkNavError, match='nav_msgs/msg/Odometry, not sensor_msgs'):
        bag.find('joint_states')


def test_what_could_be_the_missing_topic_is_reported(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        for name in ('/wheels', '/visual/odometry', '/ground_truth/odom'):
            bag.write(name, odometry(START, [0, 0, 0]), START)
        camera_image = encode.compressed_image(FACTORY, np.zeros((4, 4), np.uint8), START, 'cam')
        bag.write('/usb_cam/image_raw/compressed', camera_image, START)
    bag = Bag(tmp_path / 'bag')
    with pytest.raises(LandmarkNavError) as reported:
        bag.require('odom')
    # Of the truth it is known that it is no odometry.
    assert 'give --topic odom=/visual/odometry or --topic odom=/wheels;' in str(reported.value)
    with pytest.raises(LandmarkNavError) as reported:
        bag.require('camera/image_raw', 'camera/image_raw/compressed')
    name = 'camera/image_raw/compressed'
    assert f'--topic {name}=/usb_cam/image_raw/compressed;' in str(reported.value)
    with pytest.raises(LandmarkNavError, match='joint_states is missing: record it; there are'):
        bag.require('joint_states')
