"""Bags: a rosbag2 folder of MCAP files, or a lone MCAP file."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from copy import copy
from functools import cached_property
import heapq
import logging
from pathlib import Path
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from landmark_nav.errors import LandmarkNavError, why
from landmark_nav.messages.factory import default_typestore
from landmark_nav.storage.bags.container import ChannelInfo, McapFile, RawMessage
from landmark_nav.storage.bags.topics import find_topic, remedy_of_missing
from landmark_nav.storage.setup_files import read_yaml_mapping

__all__ = ['Bag', 'BagMessage', 'once']

_LOG = logging.getLogger(__name__)

_CONVERT = 'convert it with `rosbags-convert --src {path} --dst NEW --dst-storage mcap`'


class BagMessage:
    """
    A message of a bag, deserialised only if `message` is asked for.

    Attributes
    ----------
    topic, type_name : str
        Absolute topic and type, ``sensor_msgs/msg/Image``.
    stamp_ns : int
        When it was recorded.
    data : bytes
        As serialised (CDR).

    """

    def __init__(self, raw: RawMessage, typestore: Typestore, path: Path) -> None:
        """Keep the bytes."""
        self.topic = raw.channel.topic
        self.type_name = raw.channel.type_name
        self.stamp_ns = raw.stamp_ns
        self.data = raw.data
        self._typestore = typestore
        self._path = path

    @cached_property
    def message(self) -> Any:
        """The message; `LandmarkNavError` if its bytes are not one."""
        try:
            return self._typestore.deserialize_cdr(self.data, self.type_name)
        except (SerdeError, KeyError, AssertionError, IndexError, ValueError) as error:
            raise LandmarkNavError(
                f'{self._path}: a message on {self.topic} is not a {self.type_name} '
                f'({error}): the recording is damaged'
            ) from error


def once(messages: Iterable[BagMessage]) -> Iterator[BagMessage]:
    """Messages without those that equal the one before on their topic: recorded twice."""
    last: dict[str, bytes] = {}
    for entry in messages:
        if entry.data != last.get(entry.topic):
            last[entry.topic] = entry.data
            yield entry


class Bag:
    """
    A bag that can be read several times.

    Parameters
    ----------
    path : path-like
        A rosbag2 folder or an ``.mcap`` file.
    on_warning : callable
        Told in one line what had to be passed over; logged by default.

    Attributes
    ----------
    types : dict
        Type of each topic.
    counts : dict
        Messages of each topic.
    duration_s : float
        From the first to the last message.
    complete : bool
        Whether every file has its end.

    Raises
    ------
    LandmarkNavError
        It is not there, or is no bag of a kind that can be read.

    """

    def __init__(
        self,
        path: Path | str,
        on_warning: Callable[[str], None] = _LOG.warning,
    ) -> None:
        """Open the files and read what they hold."""
        self.path = Path(path)
        self.warn = on_warning
        try:
            self._files = [McapFile(p, on_warning) for p in _mcap_paths(self.path, on_warning)]
        except OSError as error:
            raise LandmarkNavError(f'{self.path}: cannot be read: {why(error)}') from error
        self._typestore = get_typestore(Stores.EMPTY)
        self._learned: set[ChannelInfo] = set()
        self.types: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        for file in self._files:
            for info, count in file.counts.items():
                self.types[info.topic] = info.type_name
                self.counts[info.topic] = self.counts.get(info.topic, 0) + count
        filled = [file for file in self._files if file.counts]
        self.start_ns = min((file.first_ns for file in filled), default=0)
        self.duration_s = 1e-9 * (max((f.last_ns for f in filled), default=0) - self.start_ns)
        self.complete = all(file.complete for file in self._files)

    def warning_to(self, on_warning: Callable[[str], None]) -> Bag:
        """Return the same bag, which warns somebody else: for who looks before it is read."""
        other = copy(self)
        other.warn = on_warning
        return other

    def find(self, name: str) -> str | None:
        """
        Topic that carries what the contract calls `name`, if it has messages.

        Raises
        ------
        LandmarkNavError
            Several could be it, or it is of another type.

        """
        try:
            return find_topic(name, self._filled())
        except LandmarkNavError as error:
            raise LandmarkNavError(f'{self.path}: {error}') from error

    def require(self, *alternatives: str) -> str:
        """
        Topic of the first of `alternatives` that the bag has.

        Raises
        ------
        LandmarkNavError
            None of them is there; says which topics are, and which could be it.

        """
        for name in alternatives:
            if topic := self.find(name):
                return topic
        there = ', '.join(f'{t} ({n})' for t, n in sorted(self.counts.items())) or 'none'
        raise LandmarkNavError(
            f'{self.path}: topic {" or ".join(alternatives)} is missing: '
            f'{remedy_of_missing(alternatives, self._filled())}; there are {there}'
        )

    def _filled(self) -> dict[str, str]:
        """Types of the topics that have messages."""
        return {topic: kind for topic, kind in self.types.items() if self.counts[topic]}

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """
        Messages by log time.

        Parameters
        ----------
        topics : collection of str, optional
            Absolute names as in `types`; all by default.

        Raises
        ------
        LandmarkNavError
            A file is damaged, or a topic is not written as ROS 2 messages.

        """
        self._learn_types(topics)
        merged: Iterable[RawMessage] = heapq.merge(
            *(file.messages(topics) for file in self._files), key=lambda raw: raw.stamp_ns
        )
        for raw in merged:
            yield BagMessage(raw, self._typestore, self.path)

    def _learn_types(self, topics: Collection[str] | None) -> None:
        """Register the types of `topics` as the bag itself defines them."""
        for file in self._files:
            for info in file.counts:
                if (topics is not None and info.topic not in topics) or info in self._learned:
                    continue
                self._check(info)
                text = info.schema or _standard_definition(info.type_name)
                try:
                    self._typestore.register(get_types_from_msg(text, info.type_name))
                except (TypesysError, KeyError, SyntaxError, ValueError) as error:
                    # The parser's own complaint repeats the whole definition.
                    raise LandmarkNavError(
                        f'{self.path}: topic {info.topic} is of type {info.type_name}, whose '
                        'definition in the bag is missing or damaged: record it again'
                    ) from error
                self._learned.add(info)

    def _check(self, info: ChannelInfo) -> None:
        if info.message_encoding != 'cdr' or info.schema_encoding not in ('ros2msg', ''):
            raise LandmarkNavError(
                f'{self.path}: topic {info.topic} is written as '
                f'{info.message_encoding or "nothing"} with {info.schema_encoding or "no"} '
                'schema, not as cdr with ros2msg: record it with ros2 bag'
            )


def _standard_definition(type_name: str) -> str:
    """Text of a standard message; empty where it is none."""
    standard = default_typestore()
    return standard.generate_msgdef(type_name)[0] if type_name in standard.types else ''


def _mcap_paths(path: Path, on_warning: Callable[[str], None]) -> list[Path]:
    """MCAP files of a bag in their order; refuses what is none."""
    if not path.exists():
        raise LandmarkNavError(f'{path}: no bag there: give a rosbag2 folder or an .mcap file')
    if path.is_file():
        if path.suffix in ('.db3', '.bag'):
            kind = 'an sqlite3' if path.suffix == '.db3' else 'a ROS 1'
            source = path.parent if path.suffix == '.db3' else path
            raise LandmarkNavError(f'{path}: {kind} bag: {_CONVERT.format(path=source)}')
        if path.name == 'metadata.yaml':
            raise LandmarkNavError(f'{path}: give the folder it lies in, {path.parent}')
        return [path]
    if not (path / 'metadata.yaml').is_file():
        return _without_metadata(path, on_warning)
    information = read_yaml_mapping(path / 'metadata.yaml').get('rosbag2_bagfile_information')
    if not isinstance(information, dict):
        raise LandmarkNavError(f'{path / "metadata.yaml"}: not the description of a rosbag2 bag')
    storage = str(information.get('storage_identifier', ''))
    if storage != 'mcap':
        raise LandmarkNavError(f'{path}: an {storage} bag: {_CONVERT.format(path=path)}')
    if mode := str(information.get('compression_mode') or ''):
        raise LandmarkNavError(
            f'{path}: compressed by {mode.lower()}: {_CONVERT.format(path=path)}'
        )
    names = [Path(str(name)).name for name in information.get('relative_file_paths') or []]
    missing = [name for name in names if not (path / name).is_file()]
    if missing or not names:
        raise LandmarkNavError(
            f'{path}: metadata.yaml names {", ".join(missing) or "no file"}, which is not there'
        )
    return [path / name for name in names]


def _without_metadata(path: Path, on_warning: Callable[[str], None]) -> list[Path]:
    found = sorted(path.glob('*.mcap'))
    if found:
        on_warning(f'{path}: metadata.yaml is missing: reading {len(found)} .mcap files by name')
        return found
    if any(path.glob('*.db3')):
        raise LandmarkNavError(f'{path}: an sqlite3 bag: {_CONVERT.format(path=path)}')
    raise LandmarkNavError(
        f'{path}: not a bag: a folder without metadata.yaml and without .mcap files'
    )
