"""The streams of a bag as arrays: stamps, times of recording and measured values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from landmark_nav.arrays import FloatArray, IntArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag, BagMessage
from landmark_nav.storage.bags.timelines import logged_joints

# Function from a message to its values; None if it has no usable ones.
Values = Callable[[Any], 'FloatArray | None']


@dataclass(frozen=True, eq=False)
class Stream:
    """
    One topic of a bag, in the order of its recording.

    Parameters
    ----------
    name : str
        Name of the topic in the contract, without namespace.
    topic : str
        Name of the topic in the bag.
    stamps_ns, logged_ns : ndarray of int, shape (n,)
        Stamps of the headers and times of recording.
    values : ndarray, shape (n, k)
        Measured values; (n, 0) if only the stamps are needed.
    frames : tuple of str
        Different frames in the messages, such as ``odom -> base_link``.
    refused : int
        Number of messages that cannot be decoded.
    why : str
        Reason for the first of these.
    origin_ns : int
        Origin of the seconds of all streams of a bag: its first time of recording.
    unstamped : int
        Number of messages with a stamp of 0, which the time of recording replaces.
    """

    name: str
    topic: str
    stamps_ns: IntArray
    logged_ns: IntArray
    values: FloatArray
    frames: tuple[str, ...] = ()
    refused: int = 0
    why: str = ''
    origin_ns: int = 0
    unstamped: int = 0

    @cached_property
    def seconds(self) -> FloatArray:
        """Stamps (n,) from the origin."""
        return np.asarray(1e-9 * (self.stamps_ns - self.origin_ns))

    @cached_property
    def logged(self) -> FloatArray:
        """Times of recording (n,) from the origin."""
        return np.asarray(1e-9 * (self.logged_ns - self.origin_ns))

    def __len__(self) -> int:
        """Return the number of usable messages."""
        return len(self.stamps_ns)

    def only(self, keep: Any) -> Stream:
        """Return the messages selected by an index or a mask (n,)."""
        return replace(
            self,
            stamps_ns=self.stamps_ns[keep],
            logged_ns=self.logged_ns[keep],
            values=self.values[keep],
        )


def read_stream(bag: Bag, name: str, topic: str, values: Values | None = None) -> Stream:
    """
    Read one topic of a bag.

    Parameters
    ----------
    name, topic : str
        Names of the topic in the contract and in the bag.
    values : callable, optional
        Function from a message to its values (k,); None if the message has none.
    """
    stamps, logged, numbers = [], [], []
    frames: dict[str, None] = {}
    refused, why, unstamped = 0, '', 0
    for entry in bag.messages([topic]):
        try:
            stamp, frame, measured = _one(entry, values)
        except LandmarkNavError as error:
            refused, why = refused + 1, why or str(error)
            continue
        if measured is not None:
            stamps.append(stamp)
            logged.append(entry.stamp_ns)
            unstamped += entry.header_ns == 0
            numbers.append(measured)
            frames[frame] = None
    width = len(numbers[0]) if numbers else 0
    return Stream(
        name,
        topic,
        np.array(stamps, dtype=np.int64),
        np.array(logged, dtype=np.int64),
        np.array(numbers, dtype=np.float64).reshape(len(numbers), width),
        tuple(frames),
        refused,
        why,
        bag.start_ns,
        unstamped,
    )


def _one(entry: BagMessage, values: Values | None) -> tuple[int, str, FloatArray | None]:
    message = entry.message
    try:
        measured = np.empty(0) if values is None else values(message)
        child = getattr(message, 'child_frame_id', '')
        frame = f'{message.header.frame_id}{" -> " if child else ""}{child}'
        return decode.stamp_ns(message.header), frame, measured
    except (AttributeError, TypeError, ValueError, IndexError) as error:
        raise LandmarkNavError(f'{entry.topic}: not as its type should be: {error}') from error


def read_joints(bag: Bag, topic: str) -> dict[str, Stream]:
    """Read the streams of all joints on a topic, by name; each has positions (n, 1)."""
    held: dict[str, list[tuple[int, int, float]]] = {}
    refused, why = 0, ''
    for entry in bag.messages([topic]):
        try:
            stamp, _, found = _one(entry, _positions)
        except LandmarkNavError as error:
            refused, why = refused + 1, why or str(error)
            continue
        for name, position in zip(
            entry.message.name, [] if found is None else found, strict=False
        ):
            held.setdefault(str(name), []).append((stamp, entry.stamp_ns, float(position)))
    joints = {}
    for name, rows in held.items():
        stamps, logged, angles = zip(*rows, strict=True)
        joints[name] = Stream(
            'joint_states',
            topic,
            np.array(stamps, dtype=np.int64),
            np.array(logged, dtype=np.int64),
            np.array(angles)[:, None],
            refused=refused,
            why=why,
            origin_ns=bag.start_ns,
        )
    return joints


def _positions(message: Any) -> FloatArray:
    found = np.asarray(message.position, dtype=np.float64)
    if len(found) < len(message.name) or not np.isfinite(found).all():
        raise LandmarkNavError('positions are too few or not numbers')
    return found


def unwrapped(angles: FloatArray) -> FloatArray:
    """Angles (n,) of a joint without the jumps of a driver that wraps them to one turn."""
    if len(angles) < 2:
        return angles
    extent = float(np.ptp(angles))
    # The angles may be degrees.
    for turn in (2.0 * np.pi, 360.0):
        if extent <= 1.01 * turn:
            jumps = np.abs(np.diff(angles)) > 0.5 * turn
            return np.unwrap(angles, period=turn) if jumps.any() else angles
    return angles


def pan_stream(bag: Bag, mount: PanTiltMount) -> Stream:
    """Read the pan (n, 1) of a bag from any of the topics that may hold it."""
    logged, _ = logged_joints(bag, mount)
    return Stream(
        'joint_states',
        bag.find('joint_states') or '',
        np.array([sample.stamp_ns for _, sample in logged], dtype=np.int64),
        np.array([log_ns for log_ns, _ in logged], dtype=np.int64),
        np.array([sample.pan_rad for _, sample in logged])[:, None],
        origin_ns=bag.start_ns,
    )
