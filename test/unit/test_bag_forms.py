"""A recording gives the same, whichever form its bag has."""

from __future__ import annotations

import gc
from itertools import groupby
import shutil

from bag_forms import (
    compressed_bag,
    mcap_file,
    packed_file,
    ros1_bag,
    split_bag,
    sqlite3_bag,
    without_definitions,
)
from bag_writers import MOUNT, SECOND, write_drive
from mcap.writer import CompressionType
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode

from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.bags import Bag, container, sensor_events
from landmark_nav.types import CameraFrame


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    return write_drive(tmp_path_factory.mktemp('forms') / 'drive')


def events(path):
    warnings = []
    found = list(sensor_events(Bag(path, warnings.append), MOUNT))
    assert warnings == []
    stamps = [e.stamp_ns for e in found if not isinstance(e, CameraFrame)]
    assert stamps == sorted(stamps)
    # What was recorded at one moment may come in any order.
    return sorted(
        (e.stamp_ns, type(e).__name__, getattr(e, 'pan_rad', None), repr(getattr(e, 'pose', None)))
        for e in found
    )


def by_topic(entries):
    return sorted(entries, key=lambda entry: entry.topic)


def in_blocks(entries):
    seconds = [list(block) for _, block in groupby(entries, key=lambda e: e.stamp_ns // SECOND)]
    return [entry for block in seconds[::-1] for entry in block]


FORMS = {
    'sqlite3': sqlite3_bag,
    'sqlite3 by message': lambda s, p: sqlite3_bag(s, p, CompressionMode.MESSAGE),
    'sqlite3 by file': lambda s, p: sqlite3_bag(s, p, CompressionMode.FILE),
    'mcap by message': lambda s, p: compressed_bag(s, p, CompressionMode.MESSAGE),
    'mcap by file': lambda s, p: compressed_bag(s, p, CompressionMode.FILE),
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
    'zstd': lambda s, p: packed_file(s / 'drive.mcap', p.with_suffix('.mcap.zstd')),
    'lz4': lambda s, p: packed_file(s / 'drive.mcap', p.with_suffix('.mcap.lz4')),
}  # fmt: skip


@pytest.mark.parametrize('form', FORMS)
def test_a_recording_is_the_same_in_each_form(drive, tmp_path, form):
    path = FORMS[form](drive, tmp_path / 'other')
    assert events(path) == events(drive)
    if path.is_file():
        (tmp_path / 'folder').mkdir()
        # What a file is shows in its first bytes, not in its name.
        path.rename(tmp_path / 'folder' / f'{path.name}.mcap')
        assert 'metadata.yaml is missing' in warned(tmp_path / 'folder')


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


def warned(path):
    warnings = []
    assert Bag(path, warnings.append).counts['/odom'] == 40
    return ' '.join(warnings)


def test_chunks_that_overlap_are_not_all_held_in_memory(drive, tmp_path, monkeypatch):
    path = mcap_file(drive, tmp_path / 'by_topic.mcap', by_topic)
    monkeypatch.setattr(container, '_HELD_BYTES', 30_000)
    assert events(path) == events(drive)


def test_definitions_that_are_not_in_the_bag_are_those_of_ros(drive, tmp_path):
    path = sqlite3_bag(drive, tmp_path / 'old')
    without_definitions(path)
    assert events(path) == events(drive)


@pytest.mark.parametrize('mode', ['NONE', 'none', 'None', '', 'FILE'])
def test_what_metadata_state_of_compression_is_not_needed(drive, tmp_path, mode):
    shutil.copytree(drive, tmp_path / 'copy')
    metadata = tmp_path / 'copy' / 'metadata.yaml'
    text = metadata.read_text()
    assert "compression_mode: ''" in text
    metadata.write_text(text.replace("compression_mode: ''", f"compression_mode: '{mode}'"))
    assert events(tmp_path / 'copy') == events(drive)


def test_a_folder_of_bags_states_which_are_inside(drive):
    with pytest.raises(LandmarkNavError, match=r'holds 1 bags \(drive\): give one of them'):
        Bag(drive.parent)


@pytest.mark.parametrize(
    'form', ['ros1', 'ros1 lz4', 'sqlite3', 'zstd', 'in blocks', 'index, by topic']
)
def test_damage_in_any_form_is_one_line(drive, tmp_path, form):
    whole = FORMS[form](drive, tmp_path / 'whole')
    files = [whole] if whole.is_file() else [f for f in whole.iterdir() if f.suffix != '.yaml']
    content = files[0].read_bytes()
    rng = np.random.default_rng(0)
    path = tmp_path / 'damaged'
    complaints = []
    for k in range(30):
        damaged = np.frombuffer(content, np.uint8).copy()
        places = rng.integers(8, len(damaged), 20)
        damaged[places] = rng.integers(0, 256, 20)
        cut = len(damaged) if k % 2 else int(rng.integers(100, len(damaged)))
        path.write_bytes(damaged[:cut].tobytes())
        try:
            list(sensor_events(Bag(path, lambda text: None), MOUNT))
        except LandmarkNavError as error:
            complaints.append(str(error))
    assert complaints
    assert not any('\n' in complaint for complaint in complaints)
