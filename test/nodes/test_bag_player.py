"""The exit status of `bag_player` shows whether it played the whole bag."""

import os
import sqlite3
import subprocess

from mcap.reader import make_reader
import pytest

from landmark_nav.demo.supervisor import node_command, node_environment
from landmark_nav.messages.factory import rosbag_factory
from landmark_nav.storage.bags import BagWriter


@pytest.fixture
def recording(tmp_path):
    """The MCAP file of a bag of 100 messages."""
    text = rosbag_factory()('std_msgs/msg/String', data='tick')
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(100):
            bag.write('/note', text, 10**9 + k * 10**7)
    return tmp_path / 'bag' / 'bag.mcap'


def played(path, domain_id):
    """Exit status of playing a bag, and its output."""
    done = subprocess.run(
        node_command('bag_player', bag=str(path)),
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, **node_environment(domain_id)},
    )
    return done.returncode, done.stdout + done.stderr


def test_a_damaged_chunk_is_left_out_and_named(recording, domain_id):
    with recording.open('rb') as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[-1]
    content = bytearray(recording.read_bytes())
    inside = chunk.chunk_start_offset + chunk.chunk_length // 2
    content[inside : chunk.chunk_start_offset + chunk.chunk_length] = b'\xff' * (
        chunk.chunk_length - chunk.chunk_length // 2
    )
    recording.write_bytes(content)
    status, reported = played(recording, domain_id)
    assert status == 0
    assert '1 chunk is damaged and left out' in reported
    assert 'is played' in reported


def test_messages_that_cannot_be_read_end_the_playback(tmp_path, domain_id):
    base = sqlite3.connect(tmp_path / 'odd.db3')
    base.execute('CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)')
    base.execute('CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)')
    base.execute("INSERT INTO topics VALUES (1, '/note', 'std_msgs/msg/String', 'cdr')")
    base.execute('INSERT INTO messages VALUES (1, 1, 5, 7)')
    base.commit()
    base.close()
    status, reported = played(tmp_path / 'odd.db3', domain_id)
    assert status == 1
    assert 'playback ends early: ' in reported
    assert 'is played' not in reported
    assert 'Traceback' not in reported


def test_a_bag_that_is_cut_off_is_played_up_to_the_break(recording, domain_id):
    content = recording.read_bytes()
    recording.write_bytes(content[: len(content) * 9 // 10])
    status, reported = played(recording, domain_id)
    assert status == 0
    assert 'read up to the break' in reported
    assert 'is played' in reported
