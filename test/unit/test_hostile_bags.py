"""Hostile bags: whatever they declare, memory and time are bounded, and the error is one line."""

import struct
import subprocess
import sys

import lz4.frame
import pytest
import zstandard

from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.bags import Bag

MAGIC = b'\x89MCAP0\r\n'


def text(value):
    return struct.pack('<I', len(value.encode())) + value.encode()


def record(opcode, content):
    return struct.pack('<BQ', opcode, len(content)) + content


def chunk(compression, data, declared):
    head = struct.pack('<QQQI', 1, 2, declared, 0) + text(compression)
    return record(6, head + struct.pack('<Q', len(data)) + data)


def schema(number, name, definition):
    return record(3, struct.pack('<H', number) + text(name) + text('ros2msg') + text(definition))


def channel(number, schema_number, topic):
    head = struct.pack('<HH', number, schema_number)
    return record(4, head + text(topic) + text('cdr') + struct.pack('<I', 0))


def message(number, data, log_time=5):
    return record(5, struct.pack('<HIQQ', number, 0, log_time, log_time) + data)


def mcap(*records):
    end = record(0x0F, bytes(4)) + record(2, bytes(20)) + MAGIC
    return MAGIC + record(1, text('ros2') + text('')) + b''.join(records) + end


ZEROS = bytes(2**28)
ZSTD, LZ4 = zstandard.ZstdCompressor().compress(ZEROS), lz4.frame.compress(ZEROS)
SMALL = zstandard.ZstdCompressor().compress(ZEROS[: 2**24])
BOMBS = {
    'zstd that says so': mcap(chunk('zstd', ZSTD, 2**28)),
    'zstd with a wrong size': mcap(chunk('zstd', ZSTD, 1000)),
    'lz4 that says so': mcap(chunk('lz4', LZ4, 2**28)),
    'lz4 with a wrong size': mcap(chunk('lz4', LZ4, 1000)),
    'many': mcap(*([chunk('zstd', SMALL, 2**24)] * 99)),
    'file of zstd': ZSTD * 32,
    'zstd of zstd': zstandard.ZstdCompressor().compress(ZSTD),
    'long record': mcap() + struct.pack('<BQ', 6, 2**60),
    'many channels': mcap(*(channel(k % 65535, 0, f'/{k}') for k in range(150_000))),
}  # fmt: skip

READ = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (2**30, 2**30))
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.storage.bags import Bag, sensor_events
for path in sys.argv[1:]:
    try:
        list(sensor_events(Bag(path, print), PanTiltMount()))
    except LandmarkNavError as error:
        print('refused:', error)
"""


def test_what_unpacks_to_gigabytes_is_refused_within_one(tmp_path):
    paths = [tmp_path / name.replace(' ', '_') for name in BOMBS]
    for path, content in zip(paths, BOMBS.values(), strict=True):
        path.write_bytes(content)
    done = subprocess.run(
        [sys.executable, '-c', READ, *paths], capture_output=True, text=True, check=True
    )
    lines = done.stdout.splitlines()
    refused = [line for line in lines if line.startswith('refused: ')]
    assert all(map(str.startswith, refused, (f'refused: {path}' for path in paths)))
    assert len(refused) == len(paths)
    assert len(lines) - len(refused) <= len(paths)


HEADER = '=' * 80 + '\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n'
JOINTS = (
    'std_msgs/Header header\nstring[] name\n{}\nfloat64[] velocity\nfloat64[] effort\n' + HEADER
)
DEFINITIONS = {
    'position is string': JOINTS.format('string[] position'),
    'position is float64,': JOINTS.format('float64 position'),
    r'position is float64\[3\]': JOINTS.format('float64[3] position'),
    'position of sensor_msgs/msg/JointState is missing': JOINTS.format(''),
    'more is not a field of': JOINTS.format('float64[] position').replace(
        'effort\n', 'effort\nint8 more\n'
    ),
    'stamp of std_msgs/msg/Header is missing': JOINTS.format('float64[] position').replace(
        'Header\nbuiltin_interfaces/Time stamp',
        'Header\nuint32 seq\nbuiltin_interfaces/Time stamp',
    ),
    'contains itself': 'x/A a\n' + '=' * 80 + '\nMSG: x/A\nx/A[] a\n',
    'over 100000 elements': 'float64[200000000] position\n',
    'elements': 'x/A[70000] a\n' + '=' * 80 + '\nMSG: x/A\nint8 a\nint8 b\n',
    'missing or damaged': '(' * 10_000,
    'missing or damaged:': '#' * 1_000_000,
}


@pytest.mark.parametrize('reason', DEFINITIONS)
def test_definitions_that_are_not_those_of_ros_are_named(tmp_path, reason):
    path = tmp_path / 'own.mcap'
    kind = 'sensor_msgs/msg/JointState'
    path.write_bytes(
        mcap(
            schema(1, kind, DEFINITIONS[reason]),
            channel(1, 1, '/joint_states'),
            message(1, b'\0\1\0\0' + bytes(100)),
        )
    )
    with pytest.raises(LandmarkNavError, match=reason) as error:
        list(Bag(path).messages(['/joint_states']))
    assert 'topic /joint_states' in str(error.value)
    assert len(str(error.value)) - len(str(path)) < 200
