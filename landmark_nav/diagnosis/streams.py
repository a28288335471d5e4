"""The streams of a bag as arrays: stamps, times of recording, values, sources."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray, IntArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag, BagMessage
from landmark_nav.storage.bags.reader import MessageFilter
from landmark_nav.storage.bags.timelines import logged_joints

# Function from a message to its values (k,).
Values = Callable[[Any], FloatArray]


@dataclass(frozen=True, eq=False)
class Stream:
    """
    One topic of a bag, in the order of its recording; `name` is that in the contract.

    `stamps_ns` and `logged_ns` (n,) are stamps of the headers and times of recording, whose first
    in the bag is `origin_ns`; `values` (n, k) has no columns if only stamps are needed. `frames`
    are the different ones, such as ``odom -> base_link``. `refused` messages cannot be decoded,
    the first because of `why`; `unstamped` ones have a stamp of 0, which the time of recording
    replaces.
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

    def logged_within(self, first_ns: int, last_ns: int) -> Stream:
        """Return the messages recorded from `first_ns` to `last_ns`."""
        return self.only((self.logged_ns >= first_ns) & (self.logged_ns <= last_ns))

    def only(self, keep: Any) -> Stream:
        """Return the messages selected by an index or a mask (n,)."""
        return replace(
            self,
            stamps_ns=self.stamps_ns[keep],
            logged_ns=self.logged_ns[keep],
            values=self.values[keep],
        )


class Row(NamedTuple):
    """One usable message: stamp, time of recording, frame, values, whether the stamp was 0."""

    stamp_ns: int
    logged_ns: int
    frame: str
    values: FloatArray
    unstamped: bool


def row_of(entry: BagMessage, values: Values = lambda _: np.empty(0)) -> Row:
    """Row of a message; `LandmarkNavError` if its stamp or `values` cannot be read."""
    message = entry.message
    child = getattr(message, 'child_frame_id', '')
    frame = f'{message.header.frame_id}{" -> " if child else ""}{child}'
    try:
        stamp, measured = decode.stamp_ns(message.header), values(message)
    except (TypeError, ValueError, IndexError) as error:
        raise LandmarkNavError(f'not as its type should be: {error}') from error
    return Row(stamp, entry.stamp_ns, frame, measured, entry.header_ns == 0)


def _rows(bag: Bag, topic: str, values: Values) -> tuple[list[Row], list[str]]:
    """Read the messages of a topic; return the usable ones, and why others are refused."""
    messages, row = MessageFilter(bag, topic), partial(row_of, values=values)
    rows = [messages.take(row, entry) for entry in bag.messages([topic])]
    return [row for row in rows if row is not None], messages.complaints


def stream_of(
    bag: Bag, name: str, topic: str, rows: list[Row], refused: Sequence[str] = ()
) -> Stream:
    """Arrange the messages of one topic as a stream."""
    width = len(rows[0].values) if rows else 0
    stamps, logged = np.array([row[:2] for row in rows], dtype=np.int64).reshape(-1, 2).T
    values = np.array([row.values for row in rows], dtype=np.float64).reshape(len(rows), width)
    frames = tuple(dict.fromkeys(row.frame for row in rows))
    why = refused[0].removeprefix(f'{bag.path}: ') if refused else ''
    unstamped = sum(row.unstamped for row in rows)
    rest = len(refused), why, bag.start_ns, unstamped
    return Stream(name, topic, stamps, logged, values, frames, *rest)


def read_stream(bag: Bag, name: str, topic: str, values: Values = lambda _: np.empty(0)) -> Stream:
    """Read one topic of a bag, with what `values` makes of its messages, (k,) each."""
    return stream_of(bag, name, topic, *_rows(bag, topic, values))


def read_joints(bag: Bag, topic: str) -> dict[str, Stream]:
    """Read the streams of all joints on a topic, by name; each has positions (n, 1)."""

    def positions(message: Any) -> FloatArray:
        found = np.asarray(message.position, dtype=np.float64)
        if len(found) < len(message.name) or not np.isfinite(found).all():
            raise LandmarkNavError('positions are too few or not numbers')
        if len({*message.name}) < len(message.name):
            raise LandmarkNavError('a joint is named twice: name each once')
        names.append(list(map(str, message.name)))
        return found

    names: list[list[str]] = []
    held: dict[str, list[Row]] = {}
    rows, refused = _rows(bag, topic, positions)
    for row, joints in zip(rows, names, strict=True):
        for k, joint in enumerate(joints):
            held.setdefault(joint, []).append(row._replace(values=row.values[k : k + 1]))
    return {
        joint: stream_of(bag, 'joint_states', topic, found, refused)
        for joint, found in held.items()
    }


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
    rows = [
        Row(sample.stamp_ns, log_ns, '', np.array([sample.pan_rad]), False)
        for log_ns, sample in logged
    ]
    return stream_of(bag, 'joint_states', bag.find('joint_states') or '', rows)


# Greatest rates of a robot or a joint, and least tolerance of its measurements.
_FASTEST_RAD_S, _FASTEST_M_S = 6.0, 5.0
_TOLERANCE_RAD, _TOLERANCE_M = 0.06, 0.05
_TURN_RAD = 2.0 * np.pi
# A track is extrapolated for this time at most.
_MEMORY_S = 0.5
# More tracks than these come from noise, or from another unit.
_MOST_TRACKS = 4
# The second source has at least this share of the messages, in this number of runs.
_LEAST_SHARE, _LEAST_TURNS = 0.03, 6


class Source(NamedTuple):
    """Mask (n,) of the messages of one source, its rate, and whether its values are constant."""

    keep: npt.NDArray[np.bool_]
    rate_hz: float
    stands: bool


def two_sources(stream: Stream, angles: tuple[int, ...]) -> tuple[Source, Source] | None:
    """
    Split a stream into two sources, the one with more messages first; None if there is only one.

    Columns hold positions [m], and angles [rad] if their index is in `angles`.
    """
    if not len(stream):
        return None
    # In the order of arrival: stamps may go back.
    order = np.argsort(stream.logged, kind='stable')
    # Repeated values carry no information.
    new = np.append(True, (np.diff(stream.values[order], axis=0) != 0.0).any(1))
    times, values = stream.logged[order[new]], stream.values[order[new]]
    is_angle = np.isin(np.arange(values.shape[1]), angles)
    speed = np.where(is_angle, _FASTEST_RAD_S, _FASTEST_M_S)
    tolerance = np.where(is_angle, _TOLERANCE_RAD, _TOLERANCE_M)
    tracks: list[tuple[float, FloatArray, FloatArray]] = []
    owner = np.zeros(len(times), dtype=np.intp)
    for k, (time, value) in enumerate(zip(times.tolist(), values, strict=True)):
        best, least = -1, 1.0
        for index, (last, before, rate) in enumerate(tracks):
            since = min(time - last, _MEMORY_S)
            step = np.abs(value - before - rate * since)
            turn = np.minimum(step % _TURN_RAD, _TURN_RAD - step % _TURN_RAD)
            step = np.where(is_angle, turn, step)
            away = float((step / (speed * since + tolerance)).max())
            if away < least:
                best, least = index, away
        if best < 0:
            if len(tracks) == _MOST_TRACKS:
                return None
            best = len(tracks)
            tracks.append((time, value, np.zeros_like(value)))
        last, before, rate = tracks[best]
        if time > last:
            rate = np.clip((value - before) / (time - last), -speed, speed)
        tracks[best] = (time, value, rate)
        owner[k] = best
    counts = np.bincount(owner, minlength=len(tracks))
    if len(counts) < 2:
        return None
    main, other = (int(index) for index in np.argsort(-counts, kind='stable')[:2])
    changes = np.flatnonzero(np.diff(owner) != 0) + 1
    if len(changes) < 2 * _LEAST_TURNS or counts[other] < _LEAST_SHARE * len(times):
        return None
    # Tracks may be exchanged where they cross; a constant source is identified by its value.
    alone = changes[:-1][np.diff(changes) == 1]
    kinds, often = np.unique(values[alone], axis=0, return_counts=True)
    if len(alone) >= _LEAST_TURNS and often.max() > 0.8 * len(alone):
        main, other = 0, 1
        owner = np.all(values == kinds[often.argmax()], axis=1).astype(np.intp)

    def source(index: int) -> Source:
        keep = np.zeros(len(order), dtype=np.bool_)
        keep[order[(owner == index)[np.cumsum(new) - 1]]] = True
        steps = np.diff(times[owner == index])
        period = float(np.median(steps)) if len(steps) else 0.0
        spread = float(np.ptp(values[owner == index], axis=0).max())
        return Source(keep, 1.0 / period if period > 0.0 else 0.0, spread < 1e-6)

    return source(main), source(other)
