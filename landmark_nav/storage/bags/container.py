"""
One MCAP file: its channels and its messages, also of a file that lost its end.

Format: https://mcap.dev/spec. A whole file is read through its index; one without index or footer
record by record, up to the break.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
import struct
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary

from landmark_nav.errors import LandmarkNavError

__all__ = ['ChannelInfo', 'McapFile', 'RawMessage']

_MAGIC = b'\x89MCAP0\r\n'

# Whatever the container, its decompressors and text decoding raise on damaged bytes: no list of
# it is complete, and the error of zstandard has no base but this.
_DAMAGE = Exception


@dataclass(frozen=True)
class ChannelInfo:
    """A topic of the file: how its messages are written and, in a whole file, how many."""

    topic: str
    type_name: str
    message_encoding: str
    schema_encoding: str
    schema: str


@dataclass(frozen=True)
class RawMessage:
    """A message as it lies in the file, with the time it was recorded."""

    channel: ChannelInfo
    stamp_ns: int
    data: bytes


class McapFile:
    """
    A readable MCAP file.

    Parameters
    ----------
    path : Path
        The file.
    on_warning : callable
        Told in one line if the file lost its end.

    Attributes
    ----------
    counts : dict
        Messages of each `ChannelInfo`.
    first_ns, last_ns : int
        Log times of the first and last message; 0 in an empty file.
    complete : bool
        Whether the file has its end.

    Raises
    ------
    LandmarkNavError
        It is not an MCAP file.

    """

    def __init__(self, path: Path, on_warning: Callable[[str], None]) -> None:
        """Read what the file holds."""
        self.path = path
        self.counts: dict[ChannelInfo, int] = {}
        self.first_ns = self.last_ns = 0
        with path.open('rb') as stream:
            head = stream.read(len(_MAGIC))
            if head != _MAGIC:
                raise LandmarkNavError(
                    f'{path}: not an MCAP file (it begins with {head!r}): give a rosbag2 folder '
                    'or an .mcap file'
                    if head
                    else f'{path}: empty, nothing was recorded'
                )
            summary = _summary(stream)
        self._indexed = summary is not None
        self.complete = True
        if summary is not None and _tells_all(summary):
            self._take_summary(summary)
        else:
            self._take_scan(on_warning)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages of `topics` (all by default) by log time."""
        if not self._indexed:
            yield from self._scan(topics)
            return
        infos: dict[int, ChannelInfo] = {}
        with self.path.open('rb') as stream:
            reader = make_reader(stream, validate_crcs=True)
            try:
                for schema, channel, message in reader.iter_messages(topics):
                    if channel.id not in infos:
                        infos[channel.id] = _info(channel, schema)
                    yield RawMessage(infos[channel.id], message.log_time, message.data)
            except _DAMAGE as error:
                raise LandmarkNavError(
                    f'{self.path}: damaged inside ({error}): repair it with `mcap recover`'
                ) from error

    def _take_summary(self, summary: Summary) -> None:
        statistics = summary.statistics
        assert statistics is not None, 'the caller checks'
        self.first_ns = statistics.message_start_time if statistics.message_count else 0
        self.last_ns = statistics.message_end_time if statistics.message_count else 0
        for identity, channel in summary.channels.items():
            info = _info(channel, summary.schemas.get(channel.schema_id))
            count = statistics.channel_message_counts.get(identity, 0)
            self.counts[info] = self.counts.get(info, 0) + count

    def _take_scan(self, on_warning: Callable[[str], None]) -> None:
        self._indexed = False
        self.complete = False
        for message in self._scan(None):
            self.counts[message.channel] = self.counts.get(message.channel, 0) + 1
            self.first_ns = min(self.first_ns or message.stamp_ns, message.stamp_ns)
            self.last_ns = max(self.last_ns, message.stamp_ns)
        if not self.complete:
            total = sum(self.counts.values())
            on_warning(
                f'{self.path}: cut off or damaged before its end: read up to the break, '
                f'{total} messages, {(self.last_ns - self.first_ns) * 1e-9:.1f} s'
            )

    def _scan(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        """
        Messages up to the break, in the order of the file, sorted within a chunk.

        Sets `complete` if the footer is reached.
        """
        size = self.path.stat().st_size
        schemas: dict[int, Schema] = {}
        channels: dict[int, ChannelInfo] = {}

        def message(payload: bytes) -> RawMessage | None:
            channel, _, log_time, _ = struct.unpack_from('<HIQQ', payload)
            info = channels[channel]
            if topics is not None and info.topic not in topics:
                return None
            return RawMessage(info, log_time, payload[22:])

        def define(opcode: int, payload: bytes) -> None:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(payload)))
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(payload)))
                channels[channel.id] = _info(channel, schemas.get(channel.schema_id))

        with self.path.open('rb') as stream:
            stream.seek(len(_MAGIC))
            try:
                for opcode, payload, whole in _records(stream, size - len(_MAGIC)):
                    found: list[RawMessage] = []
                    if opcode == Opcode.CHUNK:
                        inside = _chunk_content(payload, whole)
                        for kind, content, entire in _records(BytesIO(inside), len(inside)):
                            define(kind, content)
                            if kind == Opcode.MESSAGE and entire and (one := message(content)):
                                found.append(one)
                    elif opcode == Opcode.MESSAGE and whole and (one := message(payload)):
                        found.append(one)
                    elif opcode == Opcode.FOOTER and whole:
                        self.complete = True
                        return
                    elif whole:
                        define(opcode, payload)
                    yield from sorted(found, key=lambda raw: raw.stamp_ns)
            except _DAMAGE:
                return


def _summary(stream: BinaryIO) -> Summary | None:
    """Index of the file; None where it lost its end."""
    try:
        stream.seek(0)
        return make_reader(stream).get_summary()
    except _DAMAGE:
        return None


def _tells_all(summary: Summary) -> bool:
    """Whether channel and schema of every message are named; to repeat them there is optional."""
    if summary.statistics is None:
        return False
    counts = summary.statistics.channel_message_counts
    told = sum(counts.get(identity, 0) for identity in summary.channels)
    schemas = {0, *summary.schemas}
    return told == summary.statistics.message_count and all(
        channel.schema_id in schemas for channel in summary.channels.values()
    )


def _info(channel: Channel, schema: Schema | None) -> ChannelInfo:
    return ChannelInfo(
        channel.topic,
        schema.name if schema else '',
        channel.message_encoding,
        schema.encoding if schema else '',
        schema.data.decode('utf-8', 'replace') if schema else '',
    )


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, bytes, bool]]:
    """Opcode, content and whether it is whole of each record in `size` bytes."""
    left = size
    while left > 9:
        opcode, length = struct.unpack('<BQ', stream.read(9))
        left -= 9
        payload = stream.read(min(length, left))
        left -= len(payload)
        yield opcode, payload, len(payload) == length
        if len(payload) < length:
            return


def _chunk_content(payload: bytes, whole: bool) -> bytes:
    """Records in a chunk; of one that was cut off what is left, if it was not compressed."""
    if whole:
        chunk = Chunk.read(ReadDataStream(BytesIO(payload)))
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        return stream.read(length)
    # Start, end, size (8 bytes each), checksum (4), compression (length and text), length (8).
    (name_length,) = struct.unpack_from('<I', payload, 28)
    return payload[40:] if name_length == 0 else b''
