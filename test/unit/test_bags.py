"""Bags are read in each file format, and damage is reported."""

import gc
from itertools import groupby
import os
import shutil
import sqlite3

from bag_writers import (
    FACTORY,
    foreign_bag,
    MOUNT,
    odometry,
    ros1_bag,
    ROS2,
    rosbag2_bag,
    SECOND,
    START,
    write_drive,
)
import lz4.frame
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin
import yaml
import zstandard

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag, BagWriter, container, sensor_events


def mcap_file(
    source,
    path,
    order=lambda entries: entries,
    *,
    indexed=True,
    chunk_size=20_000,
    compression=CompressionType.ZSTD,
    surplus=b'',
):
    """MCAP with messages in any order, with or without an index."""
    with path.open('wb') as stream:
        summary = ('use_statistics', 'repeat_channels', 'repeat_schemas', 'use_summary_offsets')
        writer = McapWriter(
            stream, chunk_size, compression, **dict.fromkeys(summary, indexed),
            index_types=IndexType.ALL if indexed else IndexType.NONE,
        )  # fmt: skip
        writer.start('ros2')
        channels: dict[str, int] = {}
        for entry in order(list(Bag(source).messages())):
            if entry.topic not in channels:
                text = ROS2.generate_msgdef(entry.type_name, ros_version=2)[0].encode()
                schema = writer.register_schema(entry.type_name, 'ros2msg', text)
                channels[entry.topic] = writer.register_channel(entry.topic, 'cdr', schema)
            stamp = entry.stamp_ns
            data = bytes(entry.data) + surplus
            writer.add_message(channels[entry.topic], stamp, data, stamp)
        writer.finish()
    return path


def split_bag(source, path, parts=3):
    """rosbag2 in several files."""
    path.mkdir()

    def part(k):
        return lambda entries: entries[k * len(entries) // parts : (k + 1) * len(entries) // parts]

    files = [mcap_file(source, path / f'split_{k}.mcap', part(k)) for k in range(parts)]
    write_metadata(
        path, version=9, relative_file_paths=[file.name for file in files[::-1]],
        compression_format='', compression_mode='NONE',
    )  # fmt: skip
    return path


def write_metadata(path, **information):
    """`metadata.yaml` of a folder of MCAP files."""
    document = {'rosbag2_bagfile_information': {'storage_identifier': 'mcap', **information}}
    (path / 'metadata.yaml').write_text(yaml.safe_dump(document))


def packed_file(source, path):
    """A file compressed as a whole, by zstd or lz4 as its name says."""
    pack = lz4.frame.compress if path.suffix == '.lz4' else zstandard.ZstdCompressor().compress
    path.write_bytes(pack(source.read_bytes()))
    return path


def without_definitions(path):
    """Take the definitions out of a .db3, as distributions before Iron left them out."""
    (file,) = path.glob('*.db3')
    base = sqlite3.connect(file)
    base.execute('UPDATE schema SET schema_version = 3')
    base.execute('DROP TABLE message_definitions')
    base.commit()
    base.close()
    return path


def compression_mode(source, path, mode):
    """The same bag, whose metadata name a mode of compression; its first bytes count."""
    shutil.copytree(source, path)
    text = (path / 'metadata.yaml').read_text()
    assert "compression_mode: ''" in text
    changed = text.replace("compression_mode: ''", f"compression_mode: '{mode}'")
    (path / 'metadata.yaml').write_text(changed)
    return path


TEXT = ('std_msgs/msg/String', 'ros2msg', b'string data\n')
HI = b'\0\1\0\0\3\0\0\0hi\0'


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


def test_padding_behind_messages_as_rclpy_writes_it_is_passed_over(odometry_bag, tmp_path):
    padded = mcap_file(odometry_bag, tmp_path / 'padded.mcap', surplus=bytes(8))
    read, given = (list(Bag(bag).messages()) for bag in (padded, odometry_bag))
    assert [repr(entry.message) for entry in read] == [repr(entry.message) for entry in given]
    longer = mcap_file(odometry_bag, tmp_path / 'longer.mcap', surplus=bytes(16))
    with pytest.raises(LandmarkNavError, match='not a'):
        assert next(iter(Bag(longer).messages())).message is None


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


def test_what_is_no_bag_is_refused_with_what_it_is(tmp_path):
    def refused(path, match):
        with pytest.raises(LandmarkNavError, match=match) as error:
            Bag(path)
        assert '\n' not in str(error.value)

    refused(tmp_path / 'nowhere', 'no bag there')
    os.mkfifo(tmp_path / 'pipe')
    refused(tmp_path / 'pipe', 'neither a file nor a folder')
    refused(tmp_path, 'folder without metadata')
    BagWriter(tmp_path / 'bags' / 'drive').__enter__().__exit__(None, None, None)
    refused(tmp_path / 'bags', r'holds 1 bags \(drive\): give one of them')
    for name, head, match in (
        ('notes.mcap', b'hello world', r"not a bag \(it begins with 'hello wo'\)"),
        ('empty.mcap', b'', 'empty'),
        ('old.bag', b'#ROSBAG V2.0\n', 'old.bag: cannot be read'),
        ('a.db3', b'SQLite format 3\0', 'a.db3: cannot be read'),
    ):
        (tmp_path / name).write_bytes(head)
        refused(tmp_path / name, match)
    rosbag2 = tmp_path / 'rosbag2'
    rosbag2.mkdir()
    metadata = rosbag2 / 'metadata.yaml'
    for named in (None, 'a.mcap', [], ['.'], ['..'], [7], ['gone.mcap']):
        write_metadata(rosbag2, relative_file_paths=named)
        refused(rosbag2, 'which is not there')
    metadata.write_text('other: 1')
    refused(rosbag2, 'not the description')
    refused(metadata, 'give the folder')


def test_foreign_encodings_matter_only_if_they_are_asked_for(tmp_path):
    path = tmp_path / 'mixed.mcap'
    with foreign_bag(path) as add:
        add('/thing', ('Thing', 'jsonschema', b'{}'), 'json', [b'{}'])
        add('/text', TEXT, 'cdr', [HI, HI.replace(b'\3', b'\xff')])
    bag = Bag(path)
    with pytest.raises(LandmarkNavError, match='written as json with jsonschema schema'):
        list(bag.messages())
    good, bad = bag.messages(['/text'])
    assert good.message.data == 'hi'
    with pytest.raises(LandmarkNavError, match=r'/text is not a std_msgs/msg/String'):
        _ = bad.message


def test_types_come_from_the_bag_itself(tmp_path):
    pair = ('my_msgs/msg/Pair', 'ros2msg', b'int32 a\nint32 b\n')
    with foreign_bag(tmp_path / 'own.mcap') as add:
        add('/pair', pair, 'cdr', [b'\0\1\0\0\7\0\0\0\x09\0\0\0'])
    (entry,) = Bag(tmp_path / 'own.mcap').messages()
    assert (entry.message.a, entry.message.b) == (7, 9)


def test_nothing_half_written_is_left(tmp_path):
    def interrupted():
        with BagWriter(tmp_path / 'bag') as bag:
            bag.write('odom', odometry(START, [0, 0, 0]), START)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'metadata.yaml').touch()
    with pytest.raises(LandmarkNavError, match='there already'), BagWriter(tmp_path / 'bag'):
        pass


def test_missing_ambiguous_and_wrong_topics_are_reported(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        for name in ('/ground_truth/odom', '/r1/odom', '/r2/odom', 'joint_states'):
            bag.write(name, odometry(START, [0, 0, 0]), START)
    bag = Bag(tmp_path / 'bag')
    assert bag.find('ground_truth/odom') == '/ground_truth/odom'
    for ask, topic, words in (
        (bag.find, 'odom', r'several topics could be odom \(/r1/odom, /r2.*--topic odom=/r1/odom'),
        (bag.require, 'camera/camera_info', r'camera_info is missing.*/r1/odom'),
        (bag.find, 'joint_states', 'nav_msgs/msg/Odometry, not sensor_msgs'),
    ):
        with pytest.raises(LandmarkNavError, match=words):
            ask(topic)


def changed(content, at, size, value):
    return content[:at] + bytes([value]) * size + content[at + size :]


DAMAGE = {
    'bytes of a chunk': lambda c: (c.chunk_start_offset + 60, c.compressed_size - 20, 0xFF),
    'one byte': lambda c: (c.chunk_start_offset + 9 + 60, 1, 0xFF),
    'zeros in it': lambda c: (c.chunk_start_offset + 60, 20, 0),
    'its head': lambda c: (c.chunk_start_offset, 9, 0),
    'all of it': lambda c: (c.chunk_start_offset, c.chunk_length, 0),
    'its end, and what follows': lambda c: (c.chunk_start_offset + c.chunk_length - 9, 30, 0),
}


@pytest.mark.parametrize('indexed', [True, False])
@pytest.mark.parametrize('compression', CompressionType)
@pytest.mark.parametrize('damage', DAMAGE)
def test_a_damaged_chunk_is_left_out_and_reported(tmp_path, damage, compression, indexed):
    path = tmp_path / 'damaged.mcap'
    with foreign_bag(path, compression=compression, chunk_size=400) as add:
        add('/text', TEXT, 'cdr', [HI] * 100)
    with path.open('rb') as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    content = changed(path.read_bytes(), *DAMAGE[damage](chunks[1]))
    if not indexed:
        content = changed(content, len(content) - 20 - 8, 8, 0)  # the place of the summary
    path.write_bytes(content)
    warnings = []
    stamps = [entry.stamp_ns for entry in Bag(path, warnings.append).messages()]
    known = [k for k in range(1, 101) if not _in(chunks[1], k)]
    whole_to_the_break = [k for k in known if k < chunks[1].message_start_time]
    assert stamps == known or (not indexed and stamps == whole_to_the_break)
    assert 1 <= len(warnings) <= (1 if indexed else 2)
    assert all('damaged' in line and len(line) - len(str(path)) < 200 for line in warnings)


def _in(chunk, stamp):
    return chunk.message_start_time <= stamp <= chunk.message_end_time


def test_a_topic_of_which_nothing_is_left_is_named(tmp_path):
    path = write_drive(tmp_path / 'drive') / 'drive.mcap'
    with path.open('rb') as stream:
        (chunk,) = make_reader(stream).get_summary().chunk_indexes
    path.write_bytes(changed(path.read_bytes(), chunk.chunk_start_offset + 40, 999, 0))
    with pytest.raises(LandmarkNavError, match='no message can be read'):
        list(sensor_events(Bag(path), MOUNT))


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    return write_drive(tmp_path_factory.mktemp('forms') / 'drive')


def events(path):
    warnings = []
    found = list(sensor_events(Bag(path, warnings.append), MOUNT))
    assert warnings == []
    stamps = [e.stamp_ns for e in found]
    assert stamps == sorted(stamps)
    # What was recorded at one moment may come in any order.
    return sorted(
        (e.stamp_ns, type(e).__name__, getattr(e, 'pan_rad', None), repr(getattr(e, 'pose', None)))
        for e in found
    )


@pytest.fixture(scope='module')
def expected(drive):
    return events(drive)


def by_topic(entries):
    return sorted(entries, key=lambda entry: entry.topic)


def in_blocks(entries):
    seconds = [list(block) for _, block in groupby(entries, key=lambda e: e.stamp_ns // SECOND)]
    return [entry for block in seconds[::-1] for entry in block]


def at_one_log_time(entries):
    for entry in entries:
        assert entry.data
        entry.stamp_ns = START
    return entries


FORMS = {
    'sqlite3': rosbag2_bag,
    'sqlite3 by message': lambda s, p: rosbag2_bag(s, p, CompressionMode.MESSAGE),
    'sqlite3 by file': lambda s, p: rosbag2_bag(s, p, CompressionMode.FILE),
    'mcap by message': lambda s, p: rosbag2_bag(s, p, CompressionMode.MESSAGE, StoragePlugin.MCAP),
    'mcap by file': lambda s, p: rosbag2_bag(s, p, CompressionMode.FILE, StoragePlugin.MCAP),
    'sqlite3 without definitions': lambda s, p: without_definitions(rosbag2_bag(s, p)),
    'metadata that say nothing': lambda s, p: compression_mode(s, p, 'None'),
    'metadata that are wrong': lambda s, p: compression_mode(s, p, 'FILE'),
    'metadata of messages': lambda s, p: compression_mode(s, p, 'MESSAGE'),
    'split': split_bag,
    'ros1': lambda s, p: ros1_bag(s, p, None),
    'ros1 bz2': lambda s, p: ros1_bag(s, p, Ros1Writer.CompressionFormat.BZ2),
    'ros1 lz4': lambda s, p: ros1_bag(s, p, Ros1Writer.CompressionFormat.LZ4),
    'chunks': lambda s, p: mcap_file(s, p, compression=CompressionType.NONE),
    'chunks zstd': lambda s, p: mcap_file(s, p, compression=CompressionType.ZSTD),
    'chunks lz4': lambda s, p: mcap_file(s, p, compression=CompressionType.LZ4),
    'index, by topic': lambda s, p: mcap_file(s, p, by_topic),
    'index, in blocks': lambda s, p: mcap_file(s, p, in_blocks),
    'by topic': lambda s, p: mcap_file(s, p, by_topic, indexed=False),
    'in blocks': lambda s, p: mcap_file(s, p, in_blocks, indexed=False),
    'in order': lambda s, p: mcap_file(s, p, indexed=False),
    'without chunks': lambda s, p: mcap_file(s, p, by_topic, indexed=False, chunk_size=0),
    'one chunk': lambda s, p: mcap_file(s, p, in_blocks, indexed=False, chunk_size=2**30),
    'one log time': lambda s, p: mcap_file(s, p, at_one_log_time),
    'zstd': lambda s, p: packed_file(s / 'drive.mcap', p.with_suffix('.mcap.zstd')),
    'lz4': lambda s, p: packed_file(s / 'drive.mcap', p.with_suffix('.mcap.lz4')),
}  # fmt: skip


@pytest.mark.parametrize('form', FORMS)
def test_a_recording_is_the_same_in_each_form(drive, expected, tmp_path, form):
    path = FORMS[form](drive, tmp_path / 'other')
    assert events(path) == expected
    if path.is_file():
        (tmp_path / 'folder').mkdir()
        # What a file is shows in its first bytes, not in its name.
        path.rename(tmp_path / 'folder' / f'{path.name}.mcap')
        warnings = []
        assert Bag(tmp_path / 'folder', warnings.append).counts['/odom'] == 40
        assert 'metadata.yaml is missing' in ' '.join(warnings)


def test_what_was_unpacked_is_removed_with_the_bag(drive, tmp_path, monkeypatch):
    (tmp_path / 'temporary').mkdir()
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path / 'temporary'))
    path = packed_file(drive / 'drive.mcap', tmp_path / 'packed.zstd')
    messages = Bag(path).messages()
    assert len(list((tmp_path / 'temporary').iterdir())) == 1
    assert sum(entry.topic == '/odom' for entry in messages) == 40
    del messages
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(LandmarkNavError, match=r'packed\.zstd'):
        list(sensor_events(Bag(path), MOUNT))
    gc.collect()
    assert list((tmp_path / 'temporary').iterdir()) == []


def test_chunks_that_overlap_are_not_all_held_in_memory(drive, expected, tmp_path, monkeypatch):
    path = mcap_file(drive, tmp_path / 'by_topic.mcap', by_topic)
    monkeypatch.setattr(container, '_HELD_BYTES', 30_000)
    assert events(path) == expected
