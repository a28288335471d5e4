"""One recording in each file format of bags."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
import shutil
import sqlite3

import lz4.frame
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore
import yaml
import zstandard

from landmark_nav.messages.factory import default_typestore
from landmark_nav.storage.bags import Bag, BagMessage

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), default_typestore()


def _copied(
    source: Path,
    writer: Writer | Ros1Writer,
    store: Typestore,
    data_of: Callable[[BagMessage], bytes | memoryview] = lambda entry: entry.data,
) -> None:
    """Write all messages of a bag by another writer."""
    connections = {}
    with writer:
        for entry in Bag(source).messages():
            if entry.topic not in connections:
                connections[entry.topic] = writer.add_connection(
                    entry.topic, entry.type_name, typestore=store
                )
            writer.write(connections[entry.topic], entry.stamp_ns, data_of(entry))


def rosbag2_bag(
    source: Path,
    path: Path,
    mode: CompressionMode | None = None,
    storage: StoragePlugin = StoragePlugin.SQLITE3,
) -> Path:
    """rosbag2, perhaps compressed by rosbag2 itself."""
    writer = Writer(path, version=9, storage_plugin=storage)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    _copied(source, writer, ROS2)
    return path


def ros1_bag(source: Path, path: Path, compression: Ros1Writer.CompressionFormat | None) -> Path:
    """A ROS 1 bag."""
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    _copied(source, writer, ROS1, lambda entry: ROS2.cdr_to_ros1(entry.data, entry.type_name))
    return path


def mcap_file(
    source: Path,
    path: Path,
    order: Callable[[list[BagMessage]], Iterable[BagMessage]] = lambda entries: entries,
    *,
    indexed: bool = True,
    chunk_size: int = 20_000,
    compression: CompressionType = CompressionType.ZSTD,
) -> Path:
    """MCAP with messages in any order, with or without an index."""
    with path.open('wb') as stream:
        writer = McapWriter(
            stream,
            chunk_size=chunk_size,
            compression=compression,
            index_types=IndexType.ALL if indexed else IndexType.NONE,
            use_statistics=indexed,
            repeat_channels=indexed,
            repeat_schemas=indexed,
            use_summary_offsets=indexed,
        )
        writer.start('ros2')
        channels: dict[str, int] = {}
        for entry in order(list(Bag(source).messages())):
            if entry.topic not in channels:
                text = ROS2.generate_msgdef(entry.type_name, ros_version=2)[0].encode()
                schema = writer.register_schema(entry.type_name, 'ros2msg', text)
                channels[entry.topic] = writer.register_channel(entry.topic, 'cdr', schema)
            stamp = entry.stamp_ns
            writer.add_message(channels[entry.topic], stamp, bytes(entry.data), stamp)
        writer.finish()
    return path


def split_bag(source: Path, path: Path, parts: int = 3) -> Path:
    """rosbag2 in several files."""
    path.mkdir()

    def part(k: int) -> Callable[[list[BagMessage]], list[BagMessage]]:
        return lambda entries: entries[k * len(entries) // parts : (k + 1) * len(entries) // parts]

    files = [mcap_file(source, path / f'split_{k}.mcap', part(k)) for k in range(parts)]
    information = {
        'version': 9,
        'storage_identifier': 'mcap',
        'relative_file_paths': [file.name for file in files[::-1]],
        'compression_format': '',
        'compression_mode': 'NONE',
    }
    text = yaml.safe_dump({'rosbag2_bagfile_information': information})
    (path / 'metadata.yaml').write_text(text)
    return path


def packed_file(source: Path, path: Path) -> Path:
    """A file compressed as a whole, by zstd or lz4 as its name says."""
    pack = lz4.frame.compress if path.suffix == '.lz4' else zstandard.ZstdCompressor().compress
    path.write_bytes(pack(source.read_bytes()))
    return path


def without_definitions(path: Path) -> Path:
    """Take the definitions out of a .db3, as distributions before Iron left them out."""
    (file,) = path.glob('*.db3')
    base = sqlite3.connect(file)
    base.execute('UPDATE schema SET schema_version = 3')
    base.execute('DROP TABLE message_definitions')
    base.commit()
    base.close()
    return path


def compression_mode(source: Path, path: Path, mode: str) -> Path:
    """The same bag, whose metadata name a mode of compression; its first bytes count."""
    shutil.copytree(source, path)
    text = (path / 'metadata.yaml').read_text()
    assert "compression_mode: ''" in text
    changed = text.replace("compression_mode: ''", f"compression_mode: '{mode}'")
    (path / 'metadata.yaml').write_text(changed)
    return path
