"""
Reader of one MCAP file, complete or truncated: its channels and its messages.

Format: https://mcap.dev/spec. A file with a valid index is read by the index, any other one record
by record until records have no bounds. Damaged chunks are left out. Messages are sorted by log
time, and memory is bounded.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
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
from mcap.records import Channel, ChunkIndex, Footer, Schema, Statistics
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
# Opcode and length of a footer, its content, and the magic.
_FOOTER_BYTES = 9 + 20 + len(_MAGIC)

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

_READ = {
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.CHUNK_INDEX,
    Opcode.STATISTICS, Opcode.FOOTER,
}  # fmt: skip


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
        self.counts: dict[ChannelInfo, int] = {}
        self.first_ns = self.last_ns = 0
        self.complete = True
        self._ordered = True
        self._warn = on_warning
        # Reasons why chunks cannot be read, by their place in the file.
        self._damaged: dict[int, str] = {}
        index: _Index | None = None
        try:
            with path.open('rb') as stream:
                index = _Index.read(stream)
        except _TooManyChannelsError as error:
            raise LandmarkNavError(f'{self.name}: {error}') from error
        except _DAMAGE:
            pass
        self._index = index if index is not None and index.agrees else None
        if self._index is None:
            self._take_scan()
            # Damaged records hide those after them from a scan.
            if not self.complete and index is not None and index.overlap_bytes <= _HELD_BYTES:
                self._index, self.complete = index, True
        if self._index is not None:
            self._take_index(self._index)
        elif not self.complete:
            total = sum(self.counts.values())
            on_warning(
                f'{self.name}: cut off or damaged before its end ({self._break}): read up to the '
                f'break, {total} messages, {(self.last_ns - self.first_ns) * 1e-9:.1f} s'
            )

    @property
    def damaged(self) -> bool:
        """Whether a chunk that was read is damaged."""
        return bool(self._damaged)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield messages of `topics` (all by default) by log time."""
        if self._index is None:
            scanned = self._scan(topics)
            found = scanned if self._ordered else self._by_time(scanned)
        elif self._index.overlap_bytes <= _HELD_BYTES:
            found = self._index.messages(self.path, topics, self._of_chunk)
        else:
            found = self._by_time(self._scan(topics))
        known = len(self._damaged)
        try:
            yield from found
        finally:
            if lost := list(self._damaged.values())[known:]:
                count = '1 chunk is' if len(lost) == 1 else f'{len(lost)} chunks are'
                self._warn(f'{self.name}: {count} damaged and left out: {lost[0]}')

    def _of_chunk(
        self, place: int, span_ns: tuple[int, int], read: Callable[[], list[RawMessage]]
    ) -> list[RawMessage]:
        """Messages of a chunk, as `read` returns them; none if it is damaged."""
        try:
            return read()
        except _TooManyChannelsError as error:
            raise LandmarkNavError(f'{self.name}: {error}') from error
        except _DAMAGE as error:
            begin_s, end_s = (1e-9 * time_ns for time_ns in span_ns)
            self._damaged[place] = f'{begin_s:.1f} to {end_s:.1f} s ({error})'
            return []

    def _take_index(self, index: _Index) -> None:
        self.counts.clear()
        self.first_ns, self.last_ns = index.span_ns
        for identity, info in index.records.channels.items():
            self.counts[info] = self.counts.get(info, 0) + index.counts.get(identity, 0)

    def _take_scan(self) -> None:
        self.complete = False
        for message in self.messages():
            self.counts[message.channel] = self.counts.get(message.channel, 0) + 1
            self.first_ns = min(self.first_ns or message.stamp_ns, message.stamp_ns)
            self._ordered &= message.stamp_ns >= self.last_ns
            self.last_ns = max(self.last_ns, message.stamp_ns)

    def _scan(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        """
        Yield messages up to the damage, in the order of the file, sorted within a chunk.

        Set `complete` if the footer is reached.
        """
        records = _Records()
        size = self.path.stat().st_size - len(_MAGIC)
        unpacked_bytes, most = 0, most_bytes(size)
        self._break = 'it ends too early'
        with self.path.open('rb') as stream:
            stream.seek(len(_MAGIC))
            try:
                for opcode, payload, whole in _records(stream, size):
                    if opcode == Opcode.CHUNK:
                        *span_ns, declared = struct.unpack_from('<QQQ', payload)
                        unpacked_bytes += declared
                        if whole and unpacked_bytes > most:
                            raise ValueError('it unpacks to more than a recording of its size')
                        place = stream.tell() - len(payload) - 9
                        read = partial(records.of_chunk, payload, topics, whole)
                        yield from self._of_chunk(place, (span_ns[0], span_ns[1]), read)
                    elif opcode == Opcode.FOOTER and whole:
                        self.complete = True
                        return
                    elif whole and (one := records.take(opcode, payload, topics)):
                        yield one
            except _TooManyChannelsError as error:
                raise LandmarkNavError(f'{self.name}: {error}') from error
            except _DAMAGE as error:
                self._break = str(error)

    def _by_time(self, messages: Iterable[RawMessage]) -> Iterator[RawMessage]:
        """Yield messages by log time; a temporary file holds their data to spare memory."""
        places: list[tuple[int, int, int, ChannelInfo]] = []
        try:
            with TemporaryFile() as data:
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


class _TooManyChannelsError(ValueError):
    """Error: a file defines more channels than any recording."""

    def __init__(self) -> None:
        super().__init__(f'over {MAX_CHANNELS} channels: not a recording of a robot')


class _Records:
    """Channels defined by records, and the messages of records."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, ChannelInfo] = {}
        self.schema_of: dict[int, int] = {}
        # Definitions that were parsed: each chunk may repeat them.
        self._seen: dict[tuple[int, bytes], bytes] = {}
        self._defined = 0

    def take(
        self, opcode: int, payload: bytes, topics: Collection[str] | None
    ) -> RawMessage | None:
        """Keep the definition in a record; return the message in it if it is on `topics`."""
        if opcode == Opcode.MESSAGE:
            channel, _, log_time_ns, _ = struct.unpack_from('<HIQQ', payload)
            if log_time_ns > _LATEST_NS:
                raise ValueError(f'a log time of {log_time_ns} ns')
            info = self.channels[channel]
            if topics is None or info.topic in topics:
                return RawMessage(info, log_time_ns, payload[22:])
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            key = opcode, payload[:2]
            if self._seen.get(key) != payload:
                self._seen[key] = payload
                self._define(opcode, ReadDataStream(BytesIO(payload)))
        return None

    def _define(self, opcode: int, record: ReadDataStream) -> None:
        self._defined += 1
        if self._defined > 2 * MAX_CHANNELS:
            raise _TooManyChannelsError
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(record)
            self.schemas[schema.id] = schema
        else:
            channel = Channel.read(record)
            self.channels[channel.id] = _info(channel, self.schemas.get(channel.schema_id))
            self.schema_of[channel.id] = channel.schema_id

    def of_chunk(
        self, payload: bytes, topics: Collection[str] | None, whole: bool
    ) -> list[RawMessage]:
        """Messages of a chunk, complete (`whole`) or truncated, by log time."""
        content = _chunk_content(payload, whole)
        found = []
        inside = _records(BytesIO(content), len(content))
        for count, (opcode, payload, entire) in enumerate(inside):
            if count == _MAX_RECORDS or (whole and not entire):
                raise ValueError('a chunk holds what is no message')
            if entire and (message := self.take(opcode, payload, topics)):
                found.append(message)
        found.sort(key=lambda raw: raw.stamp_ns)
        return found


class _Index:
    """Summary section of a complete file; `agrees` if all its chunks begin where it says."""

    def __init__(
        self,
        records: _Records,
        statistics: Statistics,
        chunks: list[ChunkIndex],
        *,
        agrees: bool,
    ) -> None:
        self.records, self.agrees = records, agrees
        self.counts = statistics.channel_message_counts
        self.span_ns = (
            (statistics.message_start_time, statistics.message_end_time)
            if statistics.message_count
            else (0, 0)
        )
        self.chunks = sorted(chunks, key=lambda c: (c.message_start_time, c.chunk_start_offset))
        ends: list[tuple[int, int]] = []
        self.overlap_bytes = held = 0
        for chunk in self.chunks:
            while ends and ends[0][0] < chunk.message_start_time:
                held -= heapq.heappop(ends)[1]
            held += chunk.uncompressed_size
            heapq.heappush(ends, (chunk.message_end_time, chunk.uncompressed_size))
            self.overlap_bytes = max(self.overlap_bytes, held)

    @classmethod
    def read(cls, stream: BinaryIO) -> _Index | None:
        """Read the summary; None if it does not name all chunks, channels and schemas."""
        size = stream.seek(0, 2)
        stream.seek(size - _FOOTER_BYTES)
        ((opcode, footer, _),) = _records(stream, _FOOTER_BYTES - len(_MAGIC))
        if opcode != Opcode.FOOTER or stream.read() != _MAGIC:
            return None
        begin = Footer.read(ReadDataStream(BytesIO(footer))).summary_start
        if not len(_MAGIC) < begin <= size - _FOOTER_BYTES:
            return None
        records, chunks, statistics = _Records(), [], None
        stream.seek(begin)
        for opcode, payload, whole in _records(stream, size - begin):
            if opcode == Opcode.CHUNK_INDEX:
                chunks.append(ChunkIndex.read(ReadDataStream(BytesIO(payload))))
            elif opcode == Opcode.STATISTICS:
                statistics = Statistics.read(ReadDataStream(BytesIO(payload)))
            elif opcode in (Opcode.CHUNK, Opcode.MESSAGE) or not whole:
                return None
            elif opcode == Opcode.FOOTER:
                break
            else:
                records.take(opcode, payload, None)
        if statistics is None or len(chunks) != statistics.chunk_count:
            return None
        if sum(chunk.uncompressed_size for chunk in chunks) > most_bytes(size):
            return None
        counts = statistics.channel_message_counts
        named = sum(counts.get(identity, 0) for identity in records.channels)
        schemas = {0, *records.schemas}
        ends = sorted((c.chunk_start_offset, c.chunk_length) for c in chunks)
        after = [*(offset for offset, _ in ends[1:]), begin]
        sound = all(o + n <= end for (o, n), end in zip(ends, after, strict=True))
        sound &= all(c.message_start_time <= c.message_end_time for c in chunks)
        complete = named == statistics.message_count and schemas >= {*records.schema_of.values()}
        # Messages outside of chunks have no index.
        empty = not chunks and statistics.message_count
        if not sound or not complete or empty:
            return None
        agrees = all(_begins_there(stream, chunk) for chunk in chunks)
        return cls(records, statistics, chunks, agrees=agrees)

    def messages(
        self,
        path: Path,
        topics: Collection[str] | None,
        of_chunk: Callable[
            [int, tuple[int, int], Callable[[], list[RawMessage]]], list[RawMessage]
        ],
    ) -> Iterator[RawMessage]:
        """Yield messages by log time; a chunk is read when its first message is due."""
        channels = self.records.channels
        wanted = {k for k, info in channels.items() if topics is None or info.topic in topics}
        held: list[tuple[int, int, RawMessage]] = []
        order = 0
        with path.open('rb') as stream:
            for chunk in self.chunks:
                held_channels = chunk.message_index_offsets.keys()
                if held_channels and not wanted & held_channels:
                    continue
                while held and held[0][0] < chunk.message_start_time:
                    yield heapq.heappop(held)[2]
                span_ns = chunk.message_start_time, chunk.message_end_time
                read = partial(self._of_chunk, stream, chunk, topics)
                for raw in of_chunk(chunk.chunk_start_offset, span_ns, read):
                    heapq.heappush(held, (raw.stamp_ns, order, raw))
                    order += 1
        while held:
            yield heapq.heappop(held)[2]

    def _of_chunk(
        self, stream: BinaryIO, chunk: ChunkIndex, topics: Collection[str] | None
    ) -> list[RawMessage]:
        if not _begins_there(stream, chunk):
            raise ValueError('it does not begin where the index says')
        stream.seek(chunk.chunk_start_offset)
        ((_, payload, whole),) = _records(stream, chunk.chunk_length)
        if struct.unpack_from('<Q', payload, 16) != (chunk.uncompressed_size,):
            raise ValueError('it has another size than the index says')
        return self.records.of_chunk(payload, topics, whole)


def _begins_there(stream: BinaryIO, chunk: ChunkIndex) -> bool:
    stream.seek(chunk.chunk_start_offset)
    head = stream.read(9)
    return len(head) == 9 and struct.unpack('<BQ', head) == (Opcode.CHUNK, chunk.chunk_length - 9)


def _info(channel: Channel, schema: Schema | None) -> ChannelInfo:
    return ChannelInfo(
        channel.topic,
        schema.name if schema else '',
        channel.message_encoding,
        schema.encoding if schema else '',
        schema.data.decode('utf-8', 'replace') if schema else '',
    )


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, bytes, bool]]:
    """Yield opcode, content and completeness of each record in `size` bytes; others are empty."""
    left = size
    while left >= 9:
        opcode, length = struct.unpack('<BQ', stream.read(9))
        left -= 9
        if not opcode:
            raise ValueError('zeros where a record should begin')
        if opcode not in _READ:
            stream.seek(min(length, left), 1)
            left -= length
            yield opcode, b'', left >= 0
            continue
        if min(length, left) > CHUNK_BYTES + 2**16:
            raise ValueError(f'a record of {length} bytes')
        payload = stream.read(min(length, left))
        left -= len(payload)
        yield opcode, payload, len(payload) == length
        if len(payload) < length:
            return


def _chunk_content(payload: bytes, whole: bool) -> bytes:
    """Records in a chunk; of a truncated one those that are left, if it is not compressed."""
    # Start, end, size (8 bytes each), checksum (4), compression (length and text), length (8).
    _, _, size, checksum, name_length = struct.unpack_from('<QQQII', payload)
    compression = payload[32 : 32 + name_length].decode()
    data = payload[40 + name_length :]
    if not whole:
        return data if not compression else b''
    content = unpack(data, compression, size)
    if checksum and zlib.crc32(content) != checksum:
        raise ValueError('the checksum (crc) of a chunk differs')
    return content
