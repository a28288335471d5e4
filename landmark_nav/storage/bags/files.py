"""Files of a bag: readers of all formats, also split and compressed ones, and the writer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
import sqlite3
from tempfile import NamedTemporaryFile
from types import TracebackType
from typing import Any
from urllib.parse import quote
from weakref import finalize

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import ReaderError as Ros1ReaderError
from rosbags.rosbag1.reader import decompressors, Header, RecordType
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from landmark_nav.errors import LandmarkNavError, shown
from landmark_nav.messages.factory import default_typestore
from landmark_nav.storage.atomic_io import atomic_folder
from landmark_nav.storage.bags import container
from landmark_nav.storage.bags.definitions import MAP_TOPICS
from landmark_nav.storage.reading import read_yaml_mapping

_ENCODINGS = {'MSG': 'ros2msg', 'IDL': 'ros2idl', 'NONE': ''}


class RosbagsFile:
    """
    A ``.db3`` file or a ROS 1 bag, with the attributes of `McapFile`.

    Messages of ROS 1 have the message encoding ``ros1``.

    Raises `LandmarkNavError`: the file is damaged, or not a bag.
    """

    complete, damaged = True, False

    def __init__(self, path: Path, name: Path | None = None) -> None:
        self.name = name or path
        with path.open('rb') as stream:
            ros1 = stream.read(7) == b'#ROSBAG'
        with _naming(self.name):
            self._reader = _ros1(path) if ros1 else _sqlite3(path)
        finalize(self, _close, self._reader)
        self._infos: dict[int, container.ChannelInfo] = {}
        self.counts = Counter[container.ChannelInfo]()
        for connection in self._reader.connections:
            definition = connection.msgdef
            self._infos[connection.id] = info = container.ChannelInfo(
                connection.topic,
                connection.msgtype,
                'ros1' if ros1 else 'cdr',
                _ENCODINGS[definition.format.name],
                definition.data,
            )
            self.counts[info] += connection.msgcount
        of_time = self._reader if isinstance(self._reader, Ros1Reader) else self._reader.metadata
        filled = any(self.counts.values())
        self.first_ns = of_time.start_time if filled else 0
        self.last_ns = of_time.end_time - 1 if filled else 0

    def messages(self, topics: Collection[str] | None = None) -> Iterator[container.RawMessage]:
        """Yield messages of `topics` (all by default) by log time."""
        wanted = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not wanted:
            return
        with _naming(self.name):
            for connection, stamp_ns, data in self._reader.messages(wanted):
                info = self._infos[connection.id]
                # SQLite keeps values of any type.
                yield container.RawMessage(info, int(stamp_ns), bytes(memoryview(data)))


def _close(reader: Ros1Reader | Sqlite3Reader) -> None:
    with suppress(Exception):  # a reading that an error ended keeps SQLite busy
        reader.close()


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Convert any error of a reader, assertions included, to a `LandmarkNavError` of one line."""
    try:
        yield
    except LandmarkNavError:
        raise
    except Exception as error:
        remedy = ''
        if isinstance(error, sqlite3.Error):
            remedy = ': repair it by sqlite3 FILE .recover'
        elif isinstance(error, Ros1ReaderError):
            remedy = ': repair it by rosbag reindex'
        raise LandmarkNavError(f'{path}: cannot be read: {error}{remedy}') from error


def _sqlite3(path: Path) -> Sqlite3Reader:
    with closing(
        sqlite3.connect(f'file:{quote(str(path))}?mode=ro&immutable=1', uri=True)
    ) as base:
        (count,) = base.execute('SELECT count(*) FROM topics').fetchone()
        (longest,) = base.execute('SELECT max(length(data)) FROM messages').fetchone()
    _check_channels(count)
    if longest is not None and longest > container.CHUNK_BYTES:
        raise ValueError(f'a message of {longest} bytes')
    reader = Sqlite3Reader(path)
    reader.open()
    return reader


def _ros1(path: Path) -> Ros1Reader:
    with path.open('rb') as stream:
        stream.readline(80)
        header = Header.read(stream, RecordType.BAGHEADER)
    if not header.get_uint64('index_pos'):
        raise ValueError('it was not closed: fix it with `rosbag reindex`')
    _check_channels(header.get_uint32('conn_count'))
    reader = Ros1Reader(path)
    reader.open()
    names = {unbounded: name for name, unbounded in decompressors.items()}
    for place, chunk in reader.chunks.items():
        name = names[chunk.decompressor]
        bounded = partial(container.unpack, compression=name, size=None)
        reader.chunks[place] = chunk._replace(decompressor=bounded)
    return reader


def _check_channels(count: int) -> None:
    if count > container.MAX_CHANNELS:
        raise ValueError(f'{count} channels, more than a robot has')


BagFile = container.McapFile | RosbagsFile

_MCAP, _OTHERS = b'\x89MCAP0\r\n', (b'SQLite format 3\0', b'#ROSBAG')
_PACKED = (container.ZSTD, b'\x04\x22\x4d\x18')
_SUFFIXES = ('.mcap', '.db3', '.bag')
_PACKED_SUFFIXES = ('.zstd', '.zst', '.lz4')
_WHAT = 'give a rosbag2 folder or a file .mcap, .db3 or .bag'


def open_files(path: Path, on_warning: Callable[[str], None]) -> tuple[list[BagFile], bool]:
    """
    Open the files of a bag; also return whether messages are compressed one by one.

    The bag is a rosbag2 folder, a folder of bag files, or a bag file; the files may be compressed.
    `on_warning` is called with one line for each defect that is passed over. Raises
    `LandmarkNavError`: there is no bag, or a file of it is missing or damaged.
    """
    paths, by_message = _paths(path, on_warning)
    return [_opened(file, on_warning) for file in paths], by_message


def _opened(path: Path, on_warning: Callable[[str], None]) -> BagFile:
    """Open a file by the format of its first bytes; a compressed one is unpacked temporarily."""
    with path.open('rb') as stream:
        head = stream.read(16)
    if not head.startswith(_PACKED):
        return _storage(path, path, head, on_warning)
    with NamedTemporaryFile(prefix='landmark_nav_', delete=False) as unpacked:
        content = Path(unpacked.name)
        remove = partial(content.unlink, missing_ok=True)
        try:
            container.unpack_file(path, unpacked)
            unpacked.seek(0)
            file = _storage(content, path, unpacked.read(16), on_warning)
        except BaseException:
            remove()
            raise
    finalize(file, remove)
    return file


def _storage(path: Path, name: Path, head: bytes, on_warning: Callable[[str], None]) -> BagFile:
    if head.startswith(_MCAP):
        return container.McapFile(path, on_warning, name)
    if head.startswith(_OTHERS):
        return RosbagsFile(path, name)
    if not head:
        raise LandmarkNavError(f'{name}: empty, nothing was recorded')
    begin = shown(head[:8].decode('latin-1'))
    raise LandmarkNavError(f'{name}: not a bag (it begins with {begin}): {_WHAT}')


def _paths(path: Path, on_warning: Callable[[str], None]) -> tuple[list[Path], bool]:
    """Paths of the files of a bag, and whether messages are compressed one by one."""
    if not path.exists():
        raise LandmarkNavError(f'{path}: no bag there: {_WHAT}')
    if path.name == 'metadata.yaml':
        raise LandmarkNavError(f'{path}: give the folder it lies in, {path.parent}')
    if path.is_file():
        return [path], False
    if not path.is_dir():
        raise LandmarkNavError(f'{path}: neither a file nor a folder: {_WHAT}')
    if not (path / 'metadata.yaml').is_file():
        return _without_metadata(path, on_warning), False
    metadata = path / 'metadata.yaml'
    information = read_yaml_mapping(metadata).get('rosbag2_bagfile_information')
    if not isinstance(information, dict):
        raise LandmarkNavError(f'{metadata}: not the description of a rosbag2 bag')
    listed = information.get('relative_file_paths')
    found = []
    for entry in listed if isinstance(listed, list) else ():
        # Files are searched in the folder of the bag only. They may have been compressed after the
        # metadata were written; their first bytes tell.
        name = Path(entry).name if isinstance(entry, str) else ''
        files = [path / f'{name}{end}' for end in ('', *_PACKED_SUFFIXES)] if name else []
        there = [file for file in files if file.is_file()]
        if name and not there:
            raise LandmarkNavError(f'{metadata}: names {name}, which is not there')
        found += there[:1]
    if not found:
        raise LandmarkNavError(f'{metadata}: names no file, which is not there')
    return list(dict.fromkeys(found)), str(
        information.get('compression_mode')
    ).lower() == 'message'


def _without_metadata(path: Path, on_warning: Callable[[str], None]) -> list[Path]:
    if found := _bag_files(path):
        on_warning(f'{path}: metadata.yaml is missing: reading its {len(found)} bag files by name')
        return found
    inside = sorted(
        folder.name
        for folder in path.iterdir()
        if folder.is_dir() and ((folder / 'metadata.yaml').is_file() or _bag_files(folder))
    )
    if inside:
        raise LandmarkNavError(
            f'{path}: holds {len(inside)} bags ({", ".join(inside[:5])}): give one of them, '
            f'such as {path / inside[0]}'
        )
    what = 'a folder without metadata.yaml and without bag files'
    raise LandmarkNavError(f'{path}: not a bag: {what}: {_WHAT}')


def _bag_files(folder: Path) -> list[Path]:
    ends = tuple(f'{end}{packed}' for end in _SUFFIXES for packed in ('', *_PACKED_SUFFIXES))
    return sorted(file for file in folder.iterdir() if file.name.endswith(ends) and file.is_file())


# Patterns of the files in the folder of a bag, for `atomic_folder`.
_OWN = ('metadata.yaml', '*.mcap')
# Topics that `ros2 bag play` latches: it publishes each topic with the recorded QoS.
_LATCHED_TOPICS = {f'/{topic}' for topic in (*MAP_TOPICS, 'tf_static')}
_NEVER = QosTime(9223372036, 854775807)
_LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _NEVER,
    _NEVER,
    QosLiveliness.AUTOMATIC,
    _NEVER,
    False,
)


class BagWriter:
    """
    Writes a rosbag2 folder: ``metadata.yaml`` and MCAP with ``ros2msg`` schemas and ``cdr``.

    It is a context manager based on `atomic_folder`: the bag appears at `path` when the context
    ends without an exception.
    """

    def __init__(self, path: Path | str, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._folder = atomic_folder(self.path, _OWN, overwrite)
        self._store = default_typestore()
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        """Open the file; `LandmarkNavError` if `path` exists and may not be replaced."""
        # The writer names the file after its folder, so that a subfolder has the name of the bag.
        self._growing = self._folder.__enter__() / self.path.name
        # rosbag2 writes version 9 of the metadata since Jazzy.
        self._writer = Writer(self._growing, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Move the bag to its place, or remove it after an exception."""
        try:
            self._writer.__exit__(kind, error, trace)
            for file in self._growing.iterdir() if kind is None else ():
                file.rename(self._growing.parent / file.name)
            if kind is None:
                self._growing.rmdir()
        except OSError as failed:
            kind, error, trace = type(failed), failed, failed.__traceback__
        self._folder.__exit__(kind, error, trace)

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """
        Append a message made by `landmark_nav.messages.factory.rosbag_factory`.

        ``/`` is put before a relative topic.
        """
        type_name = message.__msgtype__
        data = self._store.serialize_cdr(message, type_name)
        self.write_serialized(topic, type_name, data, stamp_ns)

    def write_serialized(
        self, topic: str, type_name: str, data: bytes | memoryview, stamp_ns: int
    ) -> None:
        """Append a serialised message: CDR with its four bytes of encapsulation."""
        topic = '/' + topic.lstrip('/')
        if topic not in self._connections:
            qos = [_LATCHED] if topic in _LATCHED_TOPICS else []
            self._connections[topic] = self._writer.add_connection(
                topic, type_name, typestore=self._store, offered_qos_profiles=qos
            )
        self._writer.write(self._connections[topic], stamp_ns, data)
