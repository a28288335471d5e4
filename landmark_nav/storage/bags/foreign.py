"""What rosbag2 keeps in sqlite3 (``.db3``), and the bags of ROS 1, through rosbags."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
import sqlite3
from urllib.parse import quote
import weakref

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1.reader import decompressors, Header, RecordType
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from landmark_nav.errors import LandmarkNavError
from landmark_nav.storage.bags.container import ChannelInfo, MAX_CHANNELS, RawMessage
from landmark_nav.storage.bags.unpack import CHUNK_BYTES, unpack

__all__ = ['RosbagsFile']

_ENCODINGS = {'MSG': 'ros2msg', 'IDL': 'ros2idl', 'NONE': ''}


class RosbagsFile:
    """
    A ``.db3`` file or a ROS 1 bag, with the attributes of `McapFile`.

    Messages of ROS 1 have the message encoding ``ros1``.

    Raises
    ------
    LandmarkNavError
        It is damaged, or no bag.

    """

    complete = True

    def __init__(self, path: Path, name: Path | None = None) -> None:
        """Read what the file holds; messages call it `name`."""
        self.name = name or path
        with path.open('rb') as stream:
            ros1 = stream.read(7) == b'#ROSBAG'
        with _naming(self.name):
            self._reader = _ros1(path) if ros1 else _sqlite3(path)
        weakref.finalize(self, self._reader.close)
        self._infos = {
            connection.id: _info(connection, 'ros1' if ros1 else 'cdr')
            for connection in self._reader.connections
        }
        self.counts: dict[ChannelInfo, int] = {}
        for connection in self._reader.connections:
            info = self._infos[connection.id]
            self.counts[info] = self.counts.get(info, 0) + connection.msgcount
        of_time = self._reader if isinstance(self._reader, Ros1Reader) else self._reader.metadata
        filled = any(self.counts.values())
        self.first_ns = of_time.start_time if filled else 0
        self.last_ns = of_time.end_time - 1 if filled else 0

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages of `topics` (all by default) by log time."""
        wanted = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not wanted:
            return
        with _naming(self.name):
            for connection, stamp_ns, data in self._reader.messages(wanted):
                yield RawMessage(self._infos[connection.id], stamp_ns, data)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Whatever readers raise on damaged bytes, assertions included, in one line."""
    try:
        yield
    except LandmarkNavError:
        raise
    except Exception as error:
        raise LandmarkNavError(f'{path}: cannot be read: {error}') from error


def _sqlite3(path: Path) -> Sqlite3Reader:
    with closing(
        sqlite3.connect(f'file:{quote(str(path))}?mode=ro&immutable=1', uri=True)
    ) as base:
        (count,) = base.execute('SELECT count(*) FROM topics').fetchone()
        (longest,) = base.execute('SELECT max(length(data)) FROM messages').fetchone()
    _check_channels(count)
    if longest is not None and longest > CHUNK_BYTES:
        raise ValueError(f'a message of {longest} bytes')
    reader = Sqlite3Reader(path)
    reader.open()
    return reader


def _ros1(path: Path) -> Ros1Reader:
    with path.open('rb') as stream:
        stream.readline(80)
        header = Header.read(stream, RecordType.BAGHEADER)
    if not header.get_uint64('index_pos'):
        raise ValueError('it was not closed: mend it with `rosbag reindex`')
    _check_channels(header.get_uint32('conn_count'))
    reader = Ros1Reader(path)
    reader.open()
    names = {unbounded: name for name, unbounded in decompressors.items()}
    reader.chunks = {
        place: chunk._replace(
            decompressor=partial(unpack, compression=names[chunk.decompressor], size=None)
        )
        for place, chunk in reader.chunks.items()
    }
    return reader


def _check_channels(count: int) -> None:
    if count > MAX_CHANNELS:
        raise ValueError(f'{count} channels, more than a robot has')


def _info(connection: Connection, encoding: str) -> ChannelInfo:
    definition = connection.msgdef
    return ChannelInfo(
        connection.topic,
        connection.msgtype,
        encoding,
        _ENCODINGS[definition.format.name],
        definition.data,
    )
