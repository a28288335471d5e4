"""
Reader of bags of ROS 2 and ROS 1.

Messages that cannot be used are left out and reported.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from functools import cached_property
import heapq
from itertools import islice, starmap
import logging
from operator import itemgetter
from pathlib import Path
import struct
from typing import Any, TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from landmark_nav.arrays import IntArray
from landmark_nav.errors import LandmarkNavError, why
from landmark_nav.messages.decode.headers import is_unstamped, set_stamp
from landmark_nav.storage.bags import definitions
from landmark_nav.storage.bags.container import ChannelInfo, RawMessage, unpack, ZSTD
from landmark_nav.storage.bags.files import BagFile, open_files

_LOG = logging.getLogger(__name__)

# Number of first messages by which a topic counts as stamped or not.
_STAMPS = 20


class BagMessage:
    """A message of a bag with its log time, deserialised when `message` is first used."""

    def __init__(self, raw: RawMessage, reader: definitions.MessageReader, bag: Bag) -> None:
        self.topic = raw.channel.topic
        self.type_name = reader.type_name
        self.stamp_ns = raw.stamp_ns
        self._raw, self._reader, self._bag = raw, reader, bag

    @cached_property
    def data(self) -> bytes | memoryview:
        """Bytes in the serialisation of ROS 2 (CDR); `LandmarkNavError` if they are damaged."""
        data: bytes | memoryview = self._guarded(
            lambda: self._reader.serialized(self._bag.unpacked(self._raw.data))
        )
        return data

    @cached_property
    def message(self) -> Any:
        """
        Deserialised message; `LandmarkNavError` if its bytes are damaged.

        If its topic is not stamped, its stamp is the log time.
        """
        message = self._guarded(lambda: self._reader.message(self.data))
        if is_unstamped(message) and self.stamp_ns:
            if not self._bag.is_unstamped(self.topic):
                where = f'{self._bag.path}: a message on {self.topic}'
                raise LandmarkNavError(f'{where} has no stamp, others do: stamp all')
            set_stamp(message, self.stamp_ns)
        return message

    @property
    def header_ns(self) -> int:
        """Stamp of the header, read from the bytes without a check; 0 if they are too short."""
        try:
            order = '<' if self.data[1] else '>'
            seconds, nanoseconds = struct.unpack_from(f'{order}iI', self.data, 4)
        except (LandmarkNavError, struct.error, IndexError):
            return 0
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def _guarded(self, read: Callable[[], Any]) -> Any:
        try:
            return read()
        except LandmarkNavError:
            raise
        except Exception as error:  # readers, generated from definitions, raise any exception
            raise LandmarkNavError(
                f'{self._bag.path}: a message on {self.topic} is not a {self.type_name} '
                f'({error}): the recording is damaged'
            ) from error


def once(messages: Iterable[BagMessage]) -> Iterator[BagMessage]:
    """Yield messages without those that repeat the previous one of their topic."""
    last: dict[str, bytes | memoryview] = {}
    for entry in messages:
        if entry.data != last.get(entry.topic):
            last[entry.topic] = entry.data
            yield entry


# Passes messages through and shows progress, with their number.
Show = Callable[[Iterable[RawMessage], int], Iterable[RawMessage]]


class Bag:
    """
    A bag that can be read several times.

    It is a folder, or a file ``.mcap``, ``.db3`` or (ROS 1) ``.bag``, and may be compressed.
    `on_warning` is called with one line for each defect that is passed over; `topics` are those
    of the bag by their names in the contract, if they differ. A bag is `complete` if no file is
    truncated.

    Raises `LandmarkNavError`: the path does not exist, or is not a supported bag.
    """

    def __init__(
        self,
        path: Path | str,
        on_warning: Callable[[str], None] = _LOG.warning,
        topics: Mapping[str, str] | None = None,
    ) -> None:
        self.path = Path(path)
        self.warn = on_warning
        self._given = dict(topics or {})
        self._informed: set[str] = set()
        self._show: Show = lambda messages, _total: messages
        try:
            self._files, self._by_message = open_files(self.path, on_warning)
        except OSError as error:
            raise LandmarkNavError(f'{self.path}: cannot be read: {why(error)}') from error
        self._readers: dict[ChannelInfo, definitions.MessageReader] = {}
        self._unstamped: dict[str, bool] = {}
        # Shared with copies, as it takes a pass over the files.
        self._stamps_ns: dict[str, IntArray] = {}
        self.types: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        # Types of the messages of each topic: nodes may publish different ones.
        self._kinds: dict[str, set[str]] = {}
        for file in self._files:
            for info, count in file.counts.items():
                name = definitions.STANDARD_NAMES.get(info.type_name, info.type_name)
                self.types[info.topic] = name
                self.counts[info.topic] = self.counts.get(info.topic, 0) + count
                self._kinds.setdefault(info.topic, set()).update([name] if count else [])
        filled = [file for file in self._files if any(file.counts.values())]
        self.start_ns = min((file.first_ns for file in filled), default=0)
        self.duration_s = 1e-9 * (max((f.last_ns for f in filled), default=0) - self.start_ns)
        self.complete = all(file.complete for file in self._files)

    @property
    def damaged(self) -> bool:
        """Whether anything that was read so far had to be left out as damaged."""
        return any(file.damaged for file in self._files)

    def inform(self, text: str) -> None:
        """Issue a warning, once for each text."""
        if text not in self._informed:
            self._informed.add(text)
            self.warn(f'{self.path}: {text}')

    def warning_to(self, on_warning: Callable[[str], None]) -> Bag:
        """Return a copy with another receiver of warnings, for checks before the bag is read."""
        other = copy(self)
        other.warn = on_warning
        other._informed = set()
        return other

    def showing(self, show: Show) -> Bag:
        """Return a copy that passes messages and their number through `show` while it is read."""
        other = copy(self)
        other._show = show
        return other

    def find(self, *names: str) -> str | None:
        """
        Return the topic that the contract calls by the first of `names` that has messages.

        It is None if none has. Raises `LandmarkNavError`: the topic is ambiguous, or has another
        type.
        """
        return next((topic for name in names if (topic := self._find(name))), None)

    def _find(self, name: str) -> str | None:
        if ':' in self.given(name):
            return None  # a frame of /tf takes its place
        types, wanted = self._filled(), definitions.TOPIC_TYPES[name]
        topics = {definitions.normal_topic(topic): topic for topic in types}
        by_user = {}
        for key, topic in self._given.items():
            given = definitions.normal_topic(topic)
            by_user[definitions.with_form(key, types.get(topics.get(given, ''), ''))] = given
        if name in by_user:
            if by_user[name] not in topics:
                raise LandmarkNavError(
                    f'{self.path}: --topic {name}={by_user[name]}: not in the bag, which has '
                    f'{definitions.listed(topics)}'
                )
            found = [topics[by_user[name]]]
        else:
            others = set(topics) - set(by_user.values())
            found = [
                topics[t] for t in topics if t in others and definitions.relative_name(t) == name
            ]
            exact = [topic for topic in found if topic.strip('/') == name]
            found = exact or [topic for topic in found if types[topic] == wanted] or found
        if len(found) > 1:
            raise LandmarkNavError(
                f'{self.path}: several topics could be {name} ({definitions.listed(found)}): say '
                f'which by --topic {name}={min(found)}'
            )
        if not found:
            return None
        (topic,) = found
        if len(kinds := self._kinds[topic]) > 1:
            raise LandmarkNavError(
                f'{self.path}: topic {topic} has messages of {" and ".join(sorted(kinds))}: stop '
                'one of their nodes, or remap it, and record again'
            )
        if types[topic] != wanted:
            is_of = f'topic {topic} is of type {types[topic]}'
            raise LandmarkNavError(f'{self.path}: {is_of}, not {wanted}')
        if name not in by_user and topic.strip('/') != name:
            self.inform(f'{topic} is taken for {name}')
        return topic

    def given(self, name: str) -> str:
        """Topic that the user gives for a name in the contract; empty if none is given."""
        return self._given.get(name, '')

    def candidates(self, name: str) -> list[str]:
        """Topics that may be the one the contract calls `name`; `find` chooses among them."""
        if name in self._given:
            return list(filter(None, [self.find(name)]))
        return [
            topic
            for topic, kind in sorted(self._filled().items())
            if definitions.relative_name(topic) == name and kind == definitions.TOPIC_TYPES[name]
        ]

    def require(self, *alternatives: str) -> str:
        """
        Return the topic of the first of `alternatives` that the bag has.

        Raises `LandmarkNavError`: the bag has none of them. The message lists the topics of the
        bag, and those that could be meant.
        """
        if topic := self.find(*alternatives):
            return topic
        others, kind, wanted = definitions.OTHER_KIND.get(alternatives, ((), '', ''))
        if self.find(*others):
            raise LandmarkNavError(
                f'{self.path}: a recording of {kind}, without {alternatives[0]}: '
                f'give a bag of {wanted}'
            )
        choices = [
            f'--topic {name}={topic}'
            for name in alternatives
            for topic, kind in sorted(self._filled().items())
            if kind == definitions.TOPIC_TYPES[name]
            and definitions.relative_name(topic) not in definitions.TOPIC_TYPES
        ]
        there = definitions.listed(self._filled()) or 'none'
        remedy = f'give {" or ".join(choices[:2])}' if choices else f'record it; it has {there}'
        raise LandmarkNavError(f'{self.path}: topic {alternatives[0]} is missing: {remedy}')

    def _filled(self) -> dict[str, str]:
        """Types of the topics that have messages."""
        return {topic: kind for topic, kind in self.types.items() if self.counts[topic]}

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """
        Yield messages by log time, of all topics by default.

        Raises `LandmarkNavError`: a file is damaged, or the messages of a topic cannot be read.
        """
        for file in self._files:
            for info in file.counts:
                if topics is None or info.topic in topics:
                    self._reader(info)
        total = sum(n for topic, n in self.counts.items() if topics is None or topic in topics)
        for raw in self._show(_merged(self._files, topics), total):
            yield BagMessage(raw, self._reader(raw.channel), self)

    def is_unstamped(self, topic: str) -> bool:
        """Whether the first headers of a topic have no stamps; reported once by each copy."""
        if topic not in self._unstamped:
            first = islice(self.messages([topic]), _STAMPS)
            self._unstamped[topic] = not any(entry.header_ns for entry in first)
        if self._unstamped[topic]:
            self.inform(f'{topic} has stamps of 0: the time of recording is taken')
        return self._unstamped[topic]

    @property
    def stamps_ns(self) -> dict[str, IntArray]:
        """
        Log times and stamps (n, 2) of the messages of each topic with headers, by log time.

        A message without a stamp has its log time instead.
        """
        if self._stamps_ns:
            return self._stamps_ns
        found: dict[str, list[tuple[int, int]]] = {}
        topics = [topic for topic, kind in self._filled().items() if definitions.has_header(kind)]
        for raw in _merged(self._files, topics) if topics else ():
            entry = BagMessage(raw, self._reader(raw.channel), self)
            found.setdefault(entry.topic, []).append((entry.stamp_ns, entry.header_ns))
        for topic, pairs in found.items():
            stamps = [(log, stamp or log) for log, stamp in pairs]
            self._stamps_ns[topic] = np.array(stamps, dtype=np.int64)
        return self._stamps_ns

    def unpacked(self, data: bytes) -> bytes:
        """Data of a message, uncompressed; metadata may name a compression that there is not."""
        packed = self._by_message and data.startswith(ZSTD)
        return unpack(data, 'zstd', None) if packed else data

    def _reader(self, info: ChannelInfo) -> definitions.MessageReader:
        if info not in self._readers:
            try:
                self._readers[info] = definitions.MessageReader(info)
            except LandmarkNavError as error:
                raise LandmarkNavError(f'{self.path}: topic {info.topic}: {error}') from error
        return self._readers[info]


def _merged(files: Iterable[BagFile], topics: Collection[str] | None) -> Iterator[RawMessage]:
    """Yield messages of all files by log time; a file is read when its first message is due."""

    def read(order: int, file: BagFile) -> Iterator[tuple[int, int, RawMessage | None]]:
        yield file.first_ns, order, None
        for raw in file.messages(topics):
            yield raw.stamp_ns, order, raw

    wanted = [
        file
        for file in files
        if any(n and (topics is None or info.topic in topics) for info, n in file.counts.items())
    ]
    wanted.sort(key=lambda file: file.first_ns)
    for _, _, message in heapq.merge(*starmap(read, enumerate(wanted)), key=itemgetter(0, 1)):
        if message is not None:
            yield message


T = TypeVar('T')


# Greatest deviation of the difference of stamp and log time from the median of its neighbours.
_WRONG_STAMP_NS = 500_000_000
# Number of messages of this median; a clock that is set back changes the median too.
_AROUND = 5


def wrong_stamps(stamps_ns: IntArray) -> dict[tuple[int, int], int]:
    """Errors of wrong stamps, ns, by log times and stamps (n, 2) of the messages of a topic."""
    if len(stamps_ns) < _AROUND:
        return {}
    offsets = stamps_ns[:, 1] - stamps_ns[:, 0]
    middle = _AROUND // 2
    at = np.clip(np.arange(len(offsets)), middle, len(offsets) - 1 - middle)
    medians = np.sort(sliding_window_view(offsets, _AROUND), axis=1)[:, middle]
    off = offsets - medians[at - middle]
    wrong = np.flatnonzero(np.abs(off) > _WRONG_STAMP_NS)
    return {(int(stamps_ns[k, 0]), int(stamps_ns[k, 1])): int(off[k]) for k in wrong}


@contextmanager
def naming(bag: Bag, topic: str) -> Iterator[None]:
    """Add the names of the bag and the topic to errors."""
    try:
        yield
    except LandmarkNavError as error:
        if str(error).startswith(str(bag.path)):
            raise
        raise LandmarkNavError(f'{bag.path}: {topic}: {error}') from error
    except AttributeError as error:
        # Definitions come from the bag: a field may be missing or have another name.
        raise LandmarkNavError(
            f'{bag.path}: {topic}: its definition in the bag differs from the one of ROS 2 '
            f'({error}): record it again'
        ) from error


class MessageFilter:
    """
    Leaves out the unusable messages of a topic, and reports their number once.

    A message is unusable if its decoder refuses it, or if its stamp deviates from those of its
    neighbours by more than a transport delays messages (`wrong_stamps`). If `needed`, one must be
    usable. `complaints` are why, one each.
    """

    def __init__(
        self, bag: Bag, topic: str, what: str = 'messages', *, needed: bool = True
    ) -> None:
        self._bag, self._topic, self._what, self._needed = bag, topic, what, needed
        self._wrong_stamp_ns = wrong_stamps(bag.stamps_ns.get(topic, np.empty((0, 2), np.int64)))
        self._used = 0
        self.complaints: list[str] = []

    def take(self, decode: Callable[[BagMessage], T], entry: BagMessage) -> T | None:
        """Return the decoded message; None if it is unusable."""
        try:
            with naming(self._bag, self._topic):
                if (
                    off_ns := self._wrong_stamp_ns.get((entry.stamp_ns, entry.header_ns))
                ) is not None:
                    raise LandmarkNavError(
                        f'the stamp {1e-9 * entry.header_ns:.3f} s is {1e-9 * off_ns:+.3f} s off '
                        'those around it: its publisher must stamp it'
                    )
                event = decode(entry)
        except LandmarkNavError as error:
            self.complaints.append(str(error))
            return None
        self._used += 1
        return event

    def report(self) -> None:
        """Warn of messages left out; `LandmarkNavError` if none was usable but some are needed."""
        if not self._used and self._needed:
            nothing = f'{self._bag.path}: {self._topic}: no message can be read'
            raise LandmarkNavError(next(iter(self.complaints), nothing))
        if not self.complaints:
            return
        count = len(self.complaints)
        which = f'{count} of {self._used + count} {self._what}'
        self._bag.warn(f'{which} left out: {self.complaints[0]}')


def decoded(
    bag: Bag, topic: str, decode: Callable[[BagMessage], T], *, needed: bool = True
) -> list[T]:
    """Decoded messages of a topic, without those that `MessageFilter` leaves out."""
    messages = MessageFilter(bag, topic, needed=needed)
    found = [messages.take(decode, entry) for entry in bag.messages([topic])]
    messages.report()
    return [one for one in found if one is not None]
