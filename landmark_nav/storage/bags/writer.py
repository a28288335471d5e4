"""Atomic writer of bags."""

from __future__ import annotations

from pathlib import Path
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

from landmark_nav.messages.factory import default_typestore
from landmark_nav.storage.atomic_io import atomic_folder
from landmark_nav.storage.bags.topics import MAP_TOPICS

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
            self._connections[topic] = self._writer.add_connection(
                topic,
                type_name,
                typestore=self._store,
                offered_qos_profiles=[_LATCHED] if topic in _LATCHED_TOPICS else [],
            )
        self._writer.write(self._connections[topic], stamp_ns, data)
