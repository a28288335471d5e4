"""Bags written whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import shutil
from types import TracebackType
from typing import Any

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer

from landmark_nav.errors import LandmarkNavError, why
from landmark_nav.messages.factory import default_typestore
from landmark_nav.storage.bags.topics import MAP_TOPICS

# `ros2 bag play` latches these again: it publishes each topic as it was offered.
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
    Writes a rosbag2 folder: ``metadata.yaml`` and MCAP, ``ros2msg`` schemas, ``cdr``.

    A context manager. The bag appears at `path` when the context ends without an exception;
    until then it grows in a hidden folder beside it.

    Raises `LandmarkNavError`: something is there already.

    Parameters
    ----------
    overwrite : bool
        Whether a bag that is there may be replaced.
    """

    def __init__(self, path: Path | str, overwrite: bool = False) -> None:
        """Refuse a place that is taken."""
        self.path = Path(path)
        replaced = overwrite and (self.path / 'metadata.yaml').is_file()
        if self.path.exists() and not replaced:
            raise LandmarkNavError(f'{self.path}: exists already: remove it or take another name')
        self._growing = self.path.with_name(f'.{self.path.name}.part')
        self._store = default_typestore()
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        """Start the file."""
        with self._named():
            shutil.rmtree(self._growing, ignore_errors=True)
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # Version 9 of the metadata is what rosbag2 writes since Jazzy.
            self._writer = Writer(self._growing, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Put the bag in its place, or remove what was begun."""
        try:
            with self._named():
                self._writer.__exit__(kind, error, trace)
                if kind is None:
                    self._name_after_bag()
                    if self.path.exists():
                        shutil.rmtree(self.path)
                    self._growing.rename(self.path)
        finally:
            shutil.rmtree(self._growing, ignore_errors=True)

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Say which bag could not be written."""
        try:
            yield
        except OSError as error:
            raise LandmarkNavError(f'{self.path}: cannot be written: {why(error)}') from error

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """
        Append a message that `landmark_nav.messages.factory.rosbag_factory` made.

        Parameters
        ----------
        topic : str
            Absolute or relative name; a relative one is put under ``/``.
        """
        type_name = message.__msgtype__
        data = self._store.serialize_cdr(message, type_name)
        self.write_serialized(topic, type_name, data, stamp_ns)

    def write_serialized(
        self, topic: str, type_name: str, data: bytes | memoryview, stamp_ns: int
    ) -> None:
        """
        Append a message as it came over the wire.

        Parameters
        ----------
        type_name : str
            Of a standard message, ``sensor_msgs/msg/Image``.
        data : bytes
            CDR with its four bytes of encapsulation.
        """
        topic = '/' + topic.lstrip('/')
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic,
                type_name,
                typestore=self._store,
                offered_qos_profiles=[_LATCHED] if topic in _LATCHED_TOPICS else [],
            )
        with self._named():
            self._writer.write(self._connections[topic], stamp_ns, data)

    def _name_after_bag(self) -> None:
        """Call the file after the bag, not after the folder that it grew in."""
        grown = next(self._growing.glob('*.mcap'))
        name = f'{self.path.name}.mcap'
        grown.rename(self._growing / name)
        metadata = self._growing / 'metadata.yaml'
        text = metadata.read_text(encoding='utf-8')
        metadata.write_text(text.replace(grown.name, name), encoding='utf-8')
