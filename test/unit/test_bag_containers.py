"""MCAP files of other hands are read whole, whatever they leave out; damage is reported."""

from __future__ import annotations

from bag_writers import foreign_bag
from mcap.reader import make_reader
from mcap.writer import CompressionType
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.bags import Bag

TEXT = ('std_msgs/msg/String', 'ros2msg', b'string data\n')
HI = b'\0\1\0\0\3\0\0\0hi\0'


@pytest.mark.parametrize(
    'options',
    [
        {'repeat_channels': False, 'repeat_schemas': False},
        {'repeat_channels': False},
        {'repeat_schemas': False},
        {'use_statistics': False},
        {'repeat_channels': False, 'use_chunking': False},
    ],
)
def test_what_a_summary_may_leave_out_is_found_in_the_file(tmp_path, options):
    path = tmp_path / 'bare.mcap'
    with foreign_bag(path, **options) as add:
        add('/text', TEXT, 'cdr', [HI] * 7)
    warnings = []
    bag = Bag(path, warnings.append)
    assert bag.types == {'/text': 'std_msgs/msg/String'}
    assert bag.counts == {'/text': 7}
    assert bag.duration_s == pytest.approx(6e-9)
    assert [entry.message.data for entry in bag.messages(['/text'])] == ['hi'] * 7
    assert bag.complete
    assert warnings == []


@pytest.mark.parametrize('compression', CompressionType)
def test_damaged_chunks_are_reported(tmp_path, compression):
    path = tmp_path / 'damaged.mcap'
    with foreign_bag(path, compression=compression) as add:
        add('/text', TEXT, 'cdr', [HI] * 100)
    with path.open('rb') as stream:
        (chunk,) = make_reader(stream).get_summary().chunk_indexes
    content = bytearray(path.read_bytes())
    # Behind the head of the chunk.
    begin, size = chunk.chunk_start_offset + 60, chunk.compressed_size - 20
    content[begin : begin + size] = b'\xff' * size
    path.write_bytes(content)
    with pytest.raises(LandmarkNavError, match=r'damaged inside \(') as error:
        list(Bag(path).messages())
    assert '\n' not in str(error.value)


@pytest.mark.parametrize('indexed', [True, False])
def test_a_byte_that_changed_is_recognized_by_the_checksum(tmp_path, indexed):
    path = tmp_path / 'flipped.mcap'
    with foreign_bag(path, compression=CompressionType.NONE, use_statistics=indexed) as add:
        add('/text', TEXT, 'cdr', [HI] * 7)
    path.write_bytes(path.read_bytes().replace(b'hi\0', b'ho\0', 1))
    warnings = []
    if indexed:
        with pytest.raises(LandmarkNavError, match=r'damaged inside .*crc'):
            list(Bag(path).messages())
    else:
        assert list(Bag(path, warnings.append).messages()) == []
        assert 'cut off or damaged before its end' in warnings[0]
