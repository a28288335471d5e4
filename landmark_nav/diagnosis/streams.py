"""The streams of a bag as arrays: stamps, times of recording, values, sources."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from landmark_nav.arrays import BoolArray, FloatArray, IntArray
from landmark_nav.diagnosis.codes import Code
from landmark_nav.diagnosis.findings import Finding
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.storage.bags import Bag, BagMessage
from landmark_nav.storage.bags.reader import MessageFilter
from landmark_nav.storage.bags.timelines import logged_joints

# Streams that are compared.
IMAGES, JOINTS, ODOMETRY = 'images', 'joint_states', 'odom'


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


def read_stream(
    bag: Bag, name: str, topic: str, values: Callable[[Any], Any] = lambda _: ()
) -> Stream:
    """Read one topic of a bag, with what `values` makes of its messages, (k,) each."""
    messages, frames = MessageFilter(bag, topic), dict[str, None]()

    def row(entry: BagMessage) -> tuple[tuple[int, int, bool], Any]:
        message = entry.message
        child = getattr(message, 'child_frame_id', '')
        try:
            found = decode.stamp_ns(message.header), values(message)
        except (TypeError, ValueError, IndexError) as error:
            raise LandmarkNavError(f'not as its type should be: {error}') from error
        frames[f'{message.header.frame_id}{" -> " if child else ""}{child}'] = None
        return (found[0], entry.stamp_ns, entry.header_ns == 0), found[1]

    rows = [messages.take(row, entry) for entry in bag.messages([topic])]
    used = [found for found in rows if found is not None]
    stamps, logged, zeros = np.array([k for k, _ in used], np.int64).reshape(-1, 3).T
    table = np.array([v for _, v in used], np.float64).reshape(len(used), -1 if used else 0)
    refused = messages.complaints
    why = refused[0].removeprefix(f'{bag.path}: ') if refused else ''
    rest = tuple(frames), len(refused), why, bag.start_ns, int(zeros.sum())
    return Stream(name, topic, stamps, logged, table, *rest)


def read_joints(bag: Bag, topic: str) -> dict[str, Stream]:
    """Read the streams of all joints on a topic, by name; each has positions (n, 1)."""
    held: list[dict[str, float]] = []

    def positions(message: Any) -> tuple[()]:
        found = np.asarray(message.position, dtype=np.float64)
        if len(found) < len(message.name) or not np.isfinite(found).all():
            raise LandmarkNavError('positions are too few or not numbers')
        if len({*message.name}) < len(message.name):
            raise LandmarkNavError('a joint is named twice: name each once')
        held.append(dict(zip(map(str, message.name), found.tolist(), strict=False)))
        return ()

    every = read_stream(bag, JOINTS, topic, positions)
    joints = {}
    for joint in dict.fromkeys(name for each in held for name in each):
        keep = [k for k, each in enumerate(held) if joint in each]
        angles = np.array([held[k][joint] for k in keep])[:, None]
        joints[joint] = replace(every.only(keep), values=angles)
    return joints


def unwrapped(angles: FloatArray) -> FloatArray:
    """Angles (n,) of a joint without the jumps of a driver that wraps them to one turn."""
    extent = float(np.ptp(angles)) if len(angles) else 0.0
    # The angles may be degrees.
    for turn in (2.0 * np.pi, 360.0):
        if extent <= 1.01 * turn:
            jumps = np.abs(np.diff(angles)) > 0.5 * turn
            return np.unwrap(angles, period=turn) if jumps.any() else angles
    return angles


def pan_stream(bag: Bag, mount: PanTiltMount) -> Stream:
    """Read the pan (n, 1) of a bag from any of the topics that may hold it."""
    logged, _ = logged_joints(bag, mount)
    stamps = np.array([sample.stamp_ns for _, sample in logged], np.int64)
    times = np.array([log_ns for log_ns, _ in logged], np.int64)
    pans = np.array([sample.pan_rad for _, sample in logged])[:, None]
    topic = bag.find(JOINTS) or ''
    return Stream(JOINTS, topic, stamps, times, pans, origin_ns=bag.start_ns)


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


def one_source(stream: Stream, angles: BoolArray) -> tuple[Stream, list[Finding]]:
    """
    Return the messages of the main source of a stream, and a finding of a second one.

    The columns (k,) that are compared hold angles [rad], or positions [m].
    """
    # In the order of arrival: stamps may go back. Repeated values carry no information.
    order = np.argsort(stream.logged, kind='stable')
    values = stream.values[order][:, : len(angles)]
    new = np.append(len(values) > 0, (np.diff(values, axis=0) != 0.0).any(1))[: len(values)]
    times, values = stream.logged[order[new]], values[new]
    owner = _tracks(times, values, angles)
    counts = np.bincount(owner, minlength=2)
    main, other = (int(index) for index in np.argsort(-counts, kind='stable')[:2])
    changes = np.flatnonzero(np.diff(owner) != 0) + 1
    if len(changes) < 2 * _LEAST_TURNS or counts[other] < _LEAST_SHARE * len(times):
        return stream, []
    # Tracks may be exchanged where they cross; a constant source is identified by its value.
    alone = changes[:-1][np.diff(changes) == 1]
    kinds, often = np.unique(values[alone], axis=0, return_counts=True)
    if len(alone) >= _LEAST_TURNS and often.max() > 0.8 * len(alone):
        main, other = 0, 1
        owner = np.all(values == kinds[often.argmax()], axis=1).astype(np.intp)
    stands = {k: np.ptp(values[owner == k], axis=0).max() < 1e-6 for k in (main, other)}
    if stands[main] and not stands[other]:
        main, other = other, main  # a constant source is not the robot
    rates = [1.0 / max(float(np.median(np.diff(times[owner == k]))), 1e-9) for k in (main, other)]
    keep = np.zeros(len(stream), np.bool_)
    keep[order[(owner == main)[np.cumsum(new) - 1]]] = True
    does = 'stands still' if stands[other] else 'moves otherwise'
    texts, count = (stream.name, *rates, does, stream.topic), int((~keep).sum())
    return stream.only(keep), [Code.SOURCES.found(*texts, rates_hz=rates, messages=count)]


def _tracks(times: FloatArray, values: FloatArray, is_angle: BoolArray) -> IntArray:
    """
    Assign values (n, k) at times (n,) to the track that they continue best, by number.

    All are of one track if they make too many.
    """
    speed = np.where(is_angle, _FASTEST_RAD_S, _FASTEST_M_S)
    tolerance = np.where(is_angle, _TOLERANCE_RAD, _TOLERANCE_M)
    tracks: list[tuple[float, FloatArray, FloatArray]] = []
    owner = np.zeros(len(times), dtype=np.intp)
    for k, (time, value) in enumerate(zip(times.tolist(), values, strict=True)):
        away = [1.0]
        for last, before, rate in tracks:
            since = min(time - last, _MEMORY_S)
            step = np.abs(value - before - rate * since)
            turn = np.minimum(step % _TURN_RAD, _TURN_RAD - step % _TURN_RAD)
            step = np.where(is_angle, turn, step)
            away.append(float((step / (speed * since + tolerance)).max()))
        best = int(np.argmin(away)) - 1
        if best < 0:
            if len(tracks) == _MOST_TRACKS:
                return np.zeros(len(times), dtype=np.intp)
            best = len(tracks)
            tracks.append((time, value, np.zeros_like(value)))
        last, before, rate = tracks[best]
        if time > last:
            rate = np.clip((value - before) / (time - last), -speed, speed)
        tracks[best] = (time, value, rate)
        owner[k] = best
    return owner
