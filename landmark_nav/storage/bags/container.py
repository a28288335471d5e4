"""
Reader of one MCAP file, complete or truncated: its channels and its messages.

Format: https://mcap.dev/spec. A file is read by its index; without a valid one, its chunks are
searched until records have no bounds. Damaged chunks are left out. Messages are sorted by log
time, and memory is bounded.
"""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
import heapq
from io import BytesIO
from pathlib import Path
import struct
from tempfile import gettempdir, TemporaryFile
from typing import Any, BinaryIO, IO
import zlib

import lz4.frame
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import Channel, Chunk, ChunkIndex, Footer, Message, Schema, Statistics
from mcap.stream_reader import StreamReader
import zstandard

from landmark_nav.errors import LandmarkNavError, why

# First bytes of what zstd compressed.
ZSTD = b'\x28\xb5\x2f\xfd'
# Greatest size of an uncompressed chunk; a recorder writes chunks of 1 to 10 MB.
CHUNK_BYTES = 256 * 2**20
# Greatest compression ratio of sensor data; size to which any chunk may unpack; size to which any
# compressed file may unpack.
_RATIO, _SMALL_BYTES = 300, 64 * 2**20
_SMALL_FILE_BYTES = 2**29
_BLOCK_BYTES = 2**20


def most_bytes(size: int) -> int:
    """Greatest number of bytes that all chunks of a file of `size` bytes may unpack to."""
    return max(CHUNK_BYTES, _RATIO * size)


def unpack(data: bytes, compression: str, size: int | None) -> bytes:
    """
    Return the uncompressed content of a chunk, of declared `size`, if any.

    Raises `ValueError`: the content has not that size, or is larger than a recorder writes.
    """
    limit = min(CHUNK_BYTES, max(_SMALL_BYTES, _RATIO * len(data)))
    if size is not None and size > limit:
        raise ValueError(f'a chunk of {len(data)} bytes unpacks to {size} bytes')
    most = (limit if size is None else size) + 1
    content: bytes
    if compression in ('', 'none'):
        content = data
    elif compression == 'zstd':
        content = zstandard.ZstdDecompressor().stream_reader(data).read(most)
    elif compression == 'lz4':
        content = lz4.frame.LZ4FrameDecompressor().decompress(data, most)
    elif compression == 'bz2':
        content = bz2.BZ2Decompressor().decompress(data, most)
    else:
        raise ValueError(f'chunks compressed by {compression!r} cannot be read')
    if len(content) == most or (size is not None and len(content) < size):
        raise ValueError('a chunk does not unpack to the size that it declares')
    return content


def unpack_file(path: Path, target: IO[bytes]) -> None:
    """
    Write the content of a file compressed by zstd or lz4 to `target`.

    Raises `LandmarkNavError`: the file is damaged or unpacks to more than a recording, or the disk
    is full.
    """
    most = max(_SMALL_FILE_BYTES, most_bytes(path.stat().st_size))
    written = 0
    try:
        with path.open('rb') as stream, _opened(stream) as content:
            while block := content.read(_BLOCK_BYTES):
                written += len(block)
                if written > most:
                    raise LandmarkNavError(
                        f'{path}: unpacks to over {most / 1e9:.1f} GB, which no recording of its '
                        'size does: unpack it yourself if you trust it'
                    )
                target.write(block)
    except OSError as error:
        raise LandmarkNavError(f'{gettempdir()}: {path} unpacks to there: {why(error)}') from error
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise LandmarkNavError(f'{path}: damaged, it cannot be unpacked ({error})') from error


def _opened(stream: BinaryIO) -> Any:
    """Return a reader of the content of a compressed stream."""
    zstd = stream.read(4) == ZSTD
    stream.seek(0)
    if zstd:
        return zstandard.ZstdDecompressor().stream_reader(stream, read_across_frames=True)
    return lz4.frame.LZ4FrameFile(stream)


_MAGIC = b'\x89MCAP0\r\n'
# Size of opcode and length of a record; size of the head of a chunk without its compression.
_HEAD_BYTES, _CHUNK_HEAD_BYTES = 9, 40

# Greatest number of channels of a file; a robot has some hundreds.
MAX_CHANNELS = 65535
# Last time that fits into 64 bits with a sign.
_LATEST_NS = 2**63 - 1
# Greatest number of records of a chunk; a recorder writes some thousands.
_MAX_RECORDS = 1_000_000

# Greatest size of overlapping chunks that are held in memory; beyond it messages are sorted on
# the disk.
_HELD_BYTES = CHUNK_BYTES

# Errors that the parser, the decompressors and text decoding raise on damaged bytes: no list is
# complete, and the error of zstandard has no other base class.
_DAMAGE = Exception

_DEFINITIONS: dict[int, type[Schema | Channel]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
}
_LOOSE = {*_DEFINITIONS, Opcode.MESSAGE}


@dataclass(frozen=True)
class ChannelInfo:
    """Topic of a file, with type and encoding of its messages."""

    topic: str
    type_name: str
    message_encoding: str
    schema_encoding: str
    schema: str


@dataclass(frozen=True)
class RawMessage:
    """Serialised message of a file, with its log time."""

    channel: ChannelInfo
    stamp_ns: int
    data: bytes


@dataclass(frozen=True)
class _Part:
    """
    A chunk, or records outside of chunks (`loose`): its bytes in the file and what it holds.

    `span_ns` are the first and last log time; no topics are named if they are not known.
    """

    place: int
    length: int
    unpacked_bytes: int
    span_ns: tuple[int, int] = (0, 0)
    topics: frozenset[str] = frozenset()
    loose: bool = False


# Parts of a file, and the number of messages of each channel.
_Contents = tuple[list[_Part], dict[ChannelInfo, int]]


class McapFile:
    """
    An MCAP file, with the `counts` of messages of its channels.

    `on_warning` is called with one line if the file is truncated, hence not `complete`, or
    damaged. The log times of the first and last message are 0 for an empty file.
    """

    def __init__(
        self, path: Path, on_warning: Callable[[str], None], name: Path | None = None
    ) -> None:
        """Read the index, or all messages if there is none."""
        self.path, self.name = path, name or path
        self._warn = on_warning
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, ChannelInfo] = {}
        # Reasons why parts cannot be read, by their place in the file; how many were reported.
        self._damaged: dict[int, str] = {}
        self._reported = 0
        with path.open('rb') as stream:
            (parts, self.counts), broken = self._contents(stream)
        self.complete = not broken
        self._parts = sorted(parts, key=lambda part: (part.span_ns[0], part.place))
        spans_ns = [part.span_ns for part in parts if any(part.span_ns)]
        self.first_ns = min((begin for begin, _ in spans_ns), default=0)
        self.last_ns = max((end for _, end in spans_ns), default=0)
        self._report_damage()
        if broken:
            total, span_s = sum(self.counts.values()), (self.last_ns - self.first_ns) * 1e-9
            on_warning(
                f'{self.name}: cut off or damaged before its end ({broken}): read up to the '
                f'break, {total} messages, {span_s:.1f} s'
            )

    @property
    def damaged(self) -> bool:
        """Whether a chunk that was read is damaged."""
        return bool(self._damaged)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield messages of `topics` (all by default) by log time."""
        parts = self._parts
        if topics is not None:
            parts = [p for p in parts if not p.topics or not p.topics.isdisjoint(topics)]
        try:
            with self.path.open('rb') as stream:
                read = ((part, self._read(stream, part, topics)) for part in parts)
                fits = _overlap_bytes(parts) <= _HELD_BYTES
                yield from _merged(read) if fits else self._sorted(read)
        finally:
            self._report_damage()

    def _contents(self, stream: BinaryIO) -> tuple[_Contents, str]:
        """Parts by the index, else those that are found; also the break that ends a search."""
        index = None
        with suppress(_DAMAGE):
            index = self._index(stream)
            if index is not None and all(_begins_there(stream, part) for part in index[0]):
                return index, ''
        contents, broken = self._search(stream)
        # Damaged records hide those after them from a search.
        return (index, '') if broken and index is not None else (contents, broken)

    def _index(self, stream: BinaryIO) -> _Contents | None:
        """Read the summary; None if it does not name all chunks, channels and schemas."""
        size = stream.seek(0, 2)
        end = size - FOOTER_SIZE - len(_MAGIC)
        stream.seek(end)
        (footer,) = StreamReader(stream, skip_magic=True).records
        if not isinstance(footer, Footer) or not len(_MAGIC) < footer.summary_start <= end:
            return None
        stream.seek(footer.summary_start)
        summary = list(StreamReader(stream, skip_magic=True, emit_chunks=True).records)
        chunks = [record for record in summary if isinstance(record, ChunkIndex)]
        statistics = [record for record in summary if isinstance(record, Statistics)]
        schemas = {0}
        for record in summary:
            if isinstance(record, Schema | Channel):
                self._define(record)
            if isinstance(record, Channel):
                schemas.add(record.schema_id)
        if len(statistics) != 1 or any(isinstance(record, Chunk | Message) for record in summary):
            return None
        counted = statistics[0].channel_message_counts
        counts = Counter[ChannelInfo]()
        for identity, info in self._channels.items():
            counts[info] += counted.get(identity, 0)
        messages = statistics[0].message_count
        # Messages outside of chunks have no index.
        complete = len(chunks) == statistics[0].chunk_count and (chunks or not messages)
        complete = complete and counts.total() == messages and schemas <= {0, *self._schemas}
        if not complete or sum(k.uncompressed_size for k in chunks) > most_bytes(size):
            return None
        topics = {identity: info.topic for identity, info in self._channels.items()}
        parts = [
            _Part(
                chunk.chunk_start_offset,
                chunk.chunk_length,
                chunk.uncompressed_size,
                (chunk.message_start_time, chunk.message_end_time),
                frozenset(topics[k] for k in chunk.message_index_offsets if k in topics),
            )
            for chunk in chunks
        ]
        return parts, counts

    def _define(self, record: Schema | Channel) -> None:
        """Keep the definition of a channel, or of the type of its messages."""
        if isinstance(record, Schema):
            self._schemas[record.id] = record
            return
        schema = self._schemas.get(record.schema_id)
        self._channels[record.id] = ChannelInfo(
            record.topic,
            schema.name if schema else '',
            record.message_encoding,
            schema.encoding if schema else '',
            schema.data.decode('utf-8', 'replace') if schema else '',
        )

    def _search(self, stream: BinaryIO) -> tuple[_Contents, str]:
        """Read all parts up to where records have no bounds; also what is wrong there, if so."""
        places: list[_Part] = []
        broken = ''
        try:
            for part in _places(stream):
                last = places[-1] if places else part
                after = last.loose and part.loose and last.place + last.length == part.place
                if after and last.length < _BLOCK_BYTES:
                    together = last.length + part.length
                    places[-1] = replace(last, length=together, unpacked_bytes=together)
                else:
                    places.append(part)
        except _DAMAGE as error:
            broken = str(error)
        parts: list[_Part] = []
        counts = Counter[ChannelInfo]()
        for part in places:
            if found := self._read(stream, part, None):
                counts.update(raw.channel for raw in found)
                topics = frozenset(raw.channel.topic for raw in found)
                span_ns = found[0].stamp_ns, found[-1].stamp_ns
                parts.append(replace(part, span_ns=span_ns, topics=topics))
        return (parts, counts), broken

    def _read(
        self, stream: BinaryIO, part: _Part, topics: Collection[str] | None
    ) -> list[RawMessage]:
        """Messages of a part by log time; if it is damaged none, or the loose ones before that."""
        found: list[RawMessage] = []
        try:
            stream.seek(part.place)
            content = stream.read(part.length)
            if not part.loose:
                content = _chunk_content(content, part)
            for number, (opcode, payload) in enumerate(_records(content)):
                if number == _MAX_RECORDS:
                    raise ValueError('a chunk holds what is no message')
                if opcode == Opcode.MESSAGE:
                    channel, _, log_time_ns, _ = struct.unpack_from('<HIQQ', payload)
                    if log_time_ns > _LATEST_NS:
                        raise ValueError(f'a log time of {log_time_ns} ns')
                    info = self._channels[channel]
                    if topics is None or info.topic in topics:
                        found.append(RawMessage(info, log_time_ns, payload[22:]))
                elif opcode in _DEFINITIONS:
                    self._define(_DEFINITIONS[opcode].read(ReadDataStream(BytesIO(payload))))
        except _DAMAGE as error:
            begin_s, end_s = (1e-9 * time_ns for time_ns in part.span_ns)
            self._damaged[part.place] = f'{begin_s:.1f} to {end_s:.1f} s ({error})'
            if not part.loose:
                return []
        found.sort(key=lambda raw: raw.stamp_ns)
        return found

    def _report_damage(self) -> None:
        """Warn of the damage that was found since the last time."""
        if lost := list(self._damaged.values())[self._reported :]:
            self._reported = len(self._damaged)
            count = '1 chunk is' if len(lost) == 1 else f'{len(lost)} chunks are'
            self._warn(f'{self.name}: {count} damaged and left out: {lost[0]}')

    def _sorted(self, read: Iterable[tuple[_Part, list[RawMessage]]]) -> Iterator[RawMessage]:
        """Yield messages by log time; a temporary file holds their data to spare memory."""
        places: list[tuple[int, int, int, ChannelInfo]] = []
        try:
            with TemporaryFile() as data:
                for _, messages in read:
                    for raw in messages:
                        places.append((raw.stamp_ns, data.tell(), len(raw.data), raw.channel))
                        data.write(raw.data)
                places.sort(key=lambda place: place[:2])
                for stamp_ns, offset, size, channel in places:
                    data.seek(offset)
                    yield RawMessage(channel, stamp_ns, data.read(size))
        except OSError as error:
            raise LandmarkNavError(
                f'{gettempdir()}: messages of {self.name} are put in order there: {why(error)}'
            ) from error


def _merged(read: Iterable[tuple[_Part, list[RawMessage]]]) -> Iterator[RawMessage]:
    """Yield messages by log time; a part is read when its first message is due."""
    held: list[tuple[int, int, int, RawMessage]] = []
    for part, messages in read:
        while held and held[0][0] < part.span_ns[0]:
            yield heapq.heappop(held)[-1]
        for order, raw in enumerate(messages):
            heapq.heappush(held, (raw.stamp_ns, part.place, order, raw))
    while held:
        yield heapq.heappop(held)[-1]


def _overlap_bytes(parts: Iterable[_Part]) -> int:
    """Greatest size of parts, given by their first log times, whose times overlap."""
    ends: list[tuple[int, int]] = []
    most = held = 0
    for part in parts:
        while ends and ends[0][0] < part.span_ns[0]:
            held -= heapq.heappop(ends)[1]
        held += part.unpacked_bytes
        heapq.heappush(ends, (part.span_ns[1], part.unpacked_bytes))
        most = max(most, held)
    return most


def _begins_there(stream: BinaryIO, part: _Part) -> bool:
    """Whether a chunk begins where the index says."""
    stream.seek(part.place)
    return stream.read(_HEAD_BYTES) == struct.pack('<BQ', Opcode.CHUNK, part.length - _HEAD_BYTES)


def _places(stream: BinaryIO) -> Iterator[_Part]:
    """
    Yield chunks and loose records in the order of the file, up to the footer.

    A truncated chunk that is not compressed yields its records. Raises an error of any kind:
    records have no bounds, or unpack to more than a recording of the size.
    """
    end = stream.seek(0, 2)
    place, unpacked_bytes, most = len(_MAGIC), 0, most_bytes(end)
    while place + _HEAD_BYTES <= end:
        stream.seek(place)
        opcode, length = struct.unpack('<BQ', stream.read(_HEAD_BYTES))
        after = place + _HEAD_BYTES + length
        if not opcode:
            raise ValueError('zeros where a record should begin')
        if opcode in _LOOSE | {Opcode.CHUNK} and min(after, end) - place > CHUNK_BYTES + 2**16:
            raise ValueError(f'a record of {length} bytes')
        if opcode == Opcode.FOOTER and after <= end:
            return
        if opcode == Opcode.CHUNK:
            *span_ns, declared, _, name_length = struct.unpack('<QQQII', stream.read(32))
            if after <= end:
                unpacked_bytes += declared
                if unpacked_bytes > most:
                    raise ValueError('it unpacks to more than a recording of its size')
                size = after - place
                yield _Part(place, size, declared, (span_ns[0], span_ns[1]))
            elif not name_length:
                after = place + _HEAD_BYTES + _CHUNK_HEAD_BYTES
        elif opcode in _LOOSE and after <= end:
            yield _Part(place, after - place, after - place, loose=True)
        place = after
    raise ValueError('it ends too early')


def _records(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of each record; `ValueError` if they have no bounds."""
    place = 0
    while place < len(content):
        opcode, length = struct.unpack_from('<BQ', content, place)
        place += _HEAD_BYTES
        if not opcode or place + length > len(content):
            raise ValueError('a chunk holds what is no message')
        yield opcode, content[place : place + length]
        place += length


def _chunk_content(chunk: bytes, part: _Part) -> bytes:
    """
    Return the records in a chunk.

    Raises `ValueError`: it is not the one that the index names, or its content is damaged.
    """
    # Start, end, size (8 bytes each), checksum (4), compression (length and text), length (8).
    opcode, length, _, _, size, checksum, name_length = struct.unpack_from('<BQQQQII', chunk)
    if opcode != Opcode.CHUNK or length != part.length - _HEAD_BYTES:
        raise ValueError('it does not begin where the index says')
    if size != part.unpacked_bytes:
        raise ValueError('it has another size than the index says')
    begin = _HEAD_BYTES + 32
    compression = chunk[begin : begin + name_length].decode()
    content = unpack(chunk[begin + name_length + 8 :], compression, size)
    if checksum and zlib.crc32(content) != checksum:
        raise ValueError('the checksum (crc) of a chunk differs')
    return content
