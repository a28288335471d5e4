"""
Reader of one MCAP file, complete or truncated: its channels and its messages.

Format: https://mcap.dev/spec. The heads of all records are read, and of the chunks only those that
are needed. Damaged chunks are left out. Messages are sorted by log time, and memory is bounded.
"""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
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
from mcap.records import Channel, ChunkIndex, Footer, Schema
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

_DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
_OF_DATA = (*_DEFINITIONS, Opcode.MESSAGE, Opcode.CHUNK)


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
    """A chunk, or messages outside of chunks (`loose`): its place, and what it holds."""

    place: int
    length: int
    unpacked_bytes: int
    # First and last log time.
    span_ns: tuple[int, int] = (0, 0)
    loose: bool = False
    topics: frozenset[str] = frozenset()
    # Number of messages by number of the channel; empty if the file has no index of the messages.
    counts: dict[int, int] = field(default_factory=dict)


class McapFile:
    """
    An MCAP file, with the `counts` of messages of its channels.

    `on_warning` is called with one line if the file is truncated, hence not `complete`, or
    damaged. The log times of the first and last message are 0 for an empty file. Raises
    `LandmarkNavError`: the file defines more channels than any recording.
    """

    def __init__(
        self, path: Path, on_warning: Callable[[str], None], name: Path | None = None
    ) -> None:
        self.path, self.name = path, name or path
        self._warn = on_warning
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, ChannelInfo] = {}
        # Definitions that were parsed: each chunk may repeat them.
        self._seen: dict[tuple[int, bytes], bytes] = {}
        self._defined = 0
        # Reasons why parts cannot be read, by their place in the file; how many were reported.
        self._damaged: dict[int, str] = {}
        self._reported = 0
        self.counts = Counter[ChannelInfo]()
        with path.open('rb') as stream:
            found, broken = self._find(stream)
            parts = [self._counted(stream, part) for part in found]
        self.complete = not broken
        self._parts = sorted(filter(None, parts), key=lambda part: (part.span_ns[0], part.place))
        self.first_ns = min((part.span_ns[0] for part in self._parts), default=0)
        self.last_ns = max((part.span_ns[1] for part in self._parts), default=0)
        self._report_damage()
        if broken:
            total, span_s = self.counts.total(), (self.last_ns - self.first_ns) * 1e-9
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
            parts = [part for part in parts if not part.topics.isdisjoint(topics)]
        try:
            with self.path.open('rb') as stream:
                read = ((part, self._read(stream, part, topics)) for part in parts)
                fits = _overlap_bytes(parts) <= _HELD_BYTES
                yield from _merged(read) if fits else self._sorted(read)
        finally:
            self._report_damage()

    def _find(self, stream: BinaryIO) -> tuple[list[_Part], str]:
        """Find all parts up to where records have no bounds; also what is wrong there, if so."""
        end = stream.seek(0, 2)
        place, unpacked_bytes = len(_MAGIC), 0
        found: list[_Part] = []
        named: list[int] | None = None
        while place + _HEAD_BYTES <= end:
            stream.seek(place)
            opcode, length = struct.unpack('<BQ', stream.read(_HEAD_BYTES))
            after = place + _HEAD_BYTES + length
            too_long = opcode in _OF_DATA and min(after, end) - place > CHUNK_BYTES + 2**16
            if not opcode or too_long or after > end:
                if found:
                    found[-1].counts.clear()  # its index may be incomplete
                # Damaged records hide those after them, unless a summary names these.
                named = _named_chunks(stream, end) if named is None else named
                if onward := next((chunk for chunk in named if chunk > place), 0):
                    if place in named:
                        self._damaged[place] = 'its head'
                    place = onward
                    continue
                if not opcode:
                    return found, 'zeros where a record should begin'
                if too_long:
                    return found, f'a record of {length} bytes'
                stream.seek(place + _HEAD_BYTES)
            if opcode == Opcode.CHUNK:
                head = stream.read(_CHUNK_HEAD_BYTES)
                if len(head) < _CHUNK_HEAD_BYTES:
                    break
                first_ns, last_ns, declared, _, name_length = struct.unpack_from('<QQQII', head)
                if after <= end:
                    unpacked_bytes += declared
                    if unpacked_bytes > most_bytes(end):
                        return found, 'it unpacks to more than a recording of its size'
                    found.append(_Part(place, after - place, declared, (first_ns, last_ns)))
                elif not name_length:  # without compression, its records are read up to the break
                    after = place + _HEAD_BYTES + _CHUNK_HEAD_BYTES
            elif after > end:
                break
            elif opcode == Opcode.FOOTER:
                return found, ''
            elif opcode == Opcode.MESSAGE:
                last = found[-1] if found and found[-1].loose else None
                if last and last.place + last.length == place < last.place + _BLOCK_BYTES:
                    place = found.pop().place
                found.append(_Part(place, after - place, after - place, loose=True))
            elif opcode == Opcode.MESSAGE_INDEX and found and length >= 6:
                (channel,) = struct.unpack('<H', stream.read(2))
                found[-1].counts[channel] = (length - 6) // 16
            elif opcode in _DEFINITIONS:
                try:
                    self._take(opcode, stream.read(length), ())
                except LandmarkNavError:
                    raise
                except _DAMAGE as error:
                    self._damaged[place] = f'a definition ({error})'
            place = after
        return found, 'it ends too early'

    def _counted(self, stream: BinaryIO, part: _Part) -> _Part | None:
        """Count messages by their index, else by reading them; None if there are none."""
        infos = [self._channels.get(number) for number in part.counts]
        if infos and all(info and info.type_name for info in infos):
            counts = Counter[ChannelInfo]()
            for number, count in part.counts.items():
                counts[self._channels[number]] += count
        else:
            messages = self._read(stream, part, None)
            counts = Counter(raw.channel for raw in messages)
            if messages:
                part = replace(part, span_ns=(messages[0].stamp_ns, messages[-1].stamp_ns))
        self.counts.update(counts)
        topics = frozenset(info.topic for info in counts)
        return replace(part, topics=topics) if topics else None

    def _take(
        self, opcode: int, payload: bytes, topics: Collection[str] | None
    ) -> RawMessage | None:
        """Keep the definition in a record; return the message in it if it is on `topics`."""
        if opcode == Opcode.MESSAGE:
            number, _, log_time_ns, _ = struct.unpack_from('<HIQQ', payload)
            if log_time_ns > _LATEST_NS:
                raise ValueError(f'a log time of {log_time_ns} ns')
            info = self._channels[number]
            wanted = topics is None or info.topic in topics
            return RawMessage(info, log_time_ns, payload[22:]) if wanted else None
        key = opcode, payload[:2]
        if opcode not in _DEFINITIONS or self._seen.get(key) == payload:
            return None
        self._seen[key] = payload
        self._defined += 1
        if self._defined > 2 * MAX_CHANNELS:
            raise LandmarkNavError(f'{self.name}: over {MAX_CHANNELS} channels: no recording')
        content = ReadDataStream(BytesIO(payload))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(content)
            self._schemas[schema.id] = schema
            return None
        channel = Channel.read(content)
        known = self._schemas.get(channel.schema_id)
        if known is None:
            del self._seen[key]  # the schema may follow
        self._channels[channel.id] = ChannelInfo(
            channel.topic,
            known.name if known else '',
            channel.message_encoding,
            known.encoding if known else '',
            known.data.decode('utf-8', 'replace') if known else '',
        )
        return None

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
                if message := self._take(opcode, payload, topics):
                    found.append(message)
        except LandmarkNavError:
            raise
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


def _named_chunks(stream: BinaryIO, size: int) -> list[int]:
    """Places of the chunks that a summary names, and its own; none if it is damaged."""
    end = size - FOOTER_SIZE - len(_MAGIC)
    with suppress(_DAMAGE):
        stream.seek(end)
        (footer,) = StreamReader(stream, skip_magic=True).records
        if isinstance(footer, Footer) and len(_MAGIC) < footer.summary_start <= end:
            stream.seek(footer.summary_start)
            records = StreamReader(stream, skip_magic=True, emit_chunks=True).records
            chunks = [k.chunk_start_offset for k in records if isinstance(k, ChunkIndex)]
            return sorted({*chunks, footer.summary_start})
    return []


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
    """Return the records in a chunk."""
    # Raises `ValueError`: it is not the one that the index names, or its content is damaged.
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
