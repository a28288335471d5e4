"""The streams of a bag as arrays: stamps and their clocks, values, sources."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from landmark_nav.arrays import BoolArray, FloatArray, IndexArray, IntArray
from landmark_nav.diagnosis.findings import Code, Finding, Level
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


class _Need(NamedTuple):
    """Least rate, Hz, and longest gap, s, with which localization keeps its accuracy."""

    rate_hz: float = 0.0
    gap_s: float = np.inf
    what: str = 'the publisher'


_NEEDS = {
    IMAGES: _Need(1.0, 2.0, 'the camera'),
    JOINTS: _Need(10.0, 0.5, 'the driver of the joints'),
    ODOMETRY: _Need(5.0, 1.5, 'the odometry'),
}
# If stamps go back by more, the clock was set back; if images pause for longer, it was set
# forward, or recording was interrupted.
_SET_BACK_S, _PAUSE_S = 0.5, 60.0
# Number of messages before and after a step that measure it.
_AROUND = 10
# Greatest residual of a stamp from the line over times of recording, for messages of one clock.
_OUT_OF_STEP_S = 0.5
# Least share of the messages within that residual, for a steady clock.
_STEADY = 0.8
# Least jitter of stamps that is reported: 10 mrad while the camera turns at 1 rad/s.
_JITTER_S = 0.01
# Least significance of a drift, and least number of messages.
_DRIFT_SIGMAS, _LEAST_MESSAGES = 5.0, 8
# Messages are in a wrong order if this share of the stamps goes back, though the stamps, sorted,
# are by this factor more even than times of recording.
_SHUFFLED, _EVEN = 0.1, 0.3
# Sigmas that contain 90 % of a normal distribution.
_NORMAL_90 = 1.645
# Shares of the stamps: greatest one out of order that is normal; least one of duplicates that
# shows rounded stamps.
_OFTEN, _REPEATED = 0.01, 0.1


def check_stamps(stream: Stream) -> Iterator[Finding]:
    """Check rate, gaps, order, duplicates and zeros of the stamps of one stream."""
    name, n, need = stream.name, len(stream), _NEEDS.get(stream.name, _Need())
    if refused := stream.refused:
        counts = {'refused': refused, 'messages': n + refused}
        yield Code.VALUES.at('warning' if n else 'error', name, stream.why, **counts)
    if n < 2:
        if not refused:
            yield Code.FEW.found(name, messages=n)
        return
    if zeros := stream.unstamped:
        yield Code.ZEROS.found(name, need.what, zeros=zeros, messages=n)
    most = int((stream.stamps_ns % 1_000_000_000).max())
    # With several messages per second, some have large nanoseconds; whole seconds are rounded.
    often = np.median(np.diff(stream.logged)) < 0.5 and n > _LEAST_MESSAGES
    if often and 0 < most < 1_000_000:
        unit = 'milliseconds' if most < 1_000 else 'microseconds'
        yield Code.NANOSECONDS.found(name, unit, most_ns=most)
    steps = np.diff(stream.seconds)
    period = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    rate_hz = 1.0 / period if period else 0.0
    rated = {'rate_hz': rate_hz, 'messages': n}
    slow = rate_hz < 0.95 * need.rate_hz
    yield Code.RATE.at('warning' if slow else 'ok', name, need.rate_hz, **rated)
    longest, longest_s = int(steps.argmax()), float(steps.max())
    if longest_s > max(need.gap_s, 5.0 * period):
        at_s, until_s = (stream.logged[longest : longest + 2] - stream.logged[0]).tolist()
        code = Code.SET_FORWARD if until_s - at_s < 0.5 * longest_s else Code.GAP
        yield code.found(name, need.gap_s, need.what, longest_s=longest_s, at_s=at_s)
    if (jitter := _jitter(stream)) is not None:
        stamps_s, arrival_s = jitter
        yield Code.JITTER.found(name, need.what, stamps_s=stamps_s, arrival_s=arrival_s)
    same, back, back_s = int((steps == 0.0).sum()), int((steps < 0.0).sum()), -float(steps.min())
    if same or back:
        many = same + back > _OFTEN * n or back_s > _SET_BACK_S
        code = Code.SET_BACK if back_s > _SET_BACK_S else Code.ORDER
        counts = {'duplicates': same, 'backward': back}
        level: Level = 'warning' if many else 'ok'
        yield code.at(level, name, **counts, backward_s=max(back_s, 0.0))


def _jitter(stream: Stream) -> tuple[float, float] | None:
    """Jitter of stamps of messages that arrive more evenly, and of the arrival, s."""
    steps = np.diff([stream.seconds - stream.logged, stream.logged])
    away = np.abs(steps - np.median(steps, axis=1, keepdims=True))
    # The quantile ignores a step of the clock, but not errors of one message in five.
    jitter_s, arrival_s = (np.quantile(away, 0.9, axis=1) / _NORMAL_90).tolist()
    return None if jitter_s < _JITTER_S or arrival_s > 0.5 * jitter_s else (jitter_s, arrival_s)


def check_recording(stamps_ns: Mapping[str, IntArray]) -> Finding | None:
    """
    Find times of recording that are wrong, by log times and stamps (n, 2) of each topic.

    Stamps of messages in a wrong order are as even as they were measured, if they are sorted.
    """
    wrong = {}
    for topic, pairs in stamps_ns.items():
        logged, stamps = 1e-9 * (np.sort(pairs, axis=0) - pairs[0, 1]).T
        late_s = 1e-9 * (pairs[:, 1] - pairs[:, 0])
        away_s = float(np.quantile(np.abs(late_s - np.median(late_s)), 0.9))
        if len(pairs) < _LEAST_MESSAGES or away_s < _OUT_OF_STEP_S:
            continue
        steps = np.diff([stamps, logged])
        uneven = np.abs(steps - np.median(steps, axis=1, keepdims=True)).mean(axis=1)
        back = np.mean(np.diff(pairs[:, 1]) < 0)
        if back > _SHUFFLED and uneven[0] < _EVEN * uneven[1]:
            wrong[topic] = away_s
    return Code.RECORDING.found(', '.join(wrong), off_s=max(wrong.values())) if wrong else None


def by_arrival(stream: Stream) -> Stream:
    """Replace stamps that are rounded or jitter by times of recording with their clock."""
    if len(stream) < _LEAST_MESSAGES or not (stream.stamps_ns.any() and np.ptp(stream.logged)):
        return stream
    if np.mean(np.diff(stream.stamps_ns) == 0) < _REPEATED and _jitter(stream) is None:
        return stream
    lag = stream.seconds - stream.logged
    (drift, offset_s), covariance = np.polyfit(stream.logged, lag, 1, cov=True)
    if abs(drift) < _DRIFT_SIGMAS * np.sqrt(covariance[0, 0]):
        drift, offset_s = 0.0, float(np.median(lag))
    late_ns = np.round(1e9 * (drift * stream.logged + offset_s)).astype(np.int64)
    return replace(stream, stamps_ns=stream.logged_ns + late_ns)


def _log_clock(stream: Stream) -> tuple[float, float, FloatArray]:
    """
    Fit a robust line of stamps over times of recording (after Theil and Sen).

    Returns the offset at the start, s, the drift as a share, and the sizes of residuals (n,).
    """
    lag = stream.seconds - stream.logged
    third = max(len(lag) // 3, 1)
    apart = float(np.median(stream.logged[-third:]) - np.median(stream.logged[:third]))
    rise = float(np.median(lag[-third:]) - np.median(lag[:third]))
    drift = rise / apart if apart > 0.0 else 0.0
    rest = lag - drift * stream.logged
    offset = float(np.median(rest))
    return offset, drift, np.abs(rest - offset)


def in_step(stream: Stream) -> Stream:
    """Return the messages whose stamps follow the clock of the majority."""
    _, _, away = _log_clock(stream)
    keep = away < max(_OUT_OF_STEP_S, 6.0 * float(np.median(away)))
    return stream if keep.all() else stream.only(keep)


def _breaks(images: Stream) -> IndexArray:
    """Images, by number, before which stamps go back or pause."""
    steps = np.diff(images.seconds)
    return np.flatnonzero((steps < -_SET_BACK_S) | (steps > _PAUSE_S)) + 1


def lone_steps(images: Stream, others: Sequence[Stream]) -> Iterator[tuple[float, float]]:
    """Yield steps of the clock of the images that no other stream has, s, and their times, s."""

    def step(stream: Stream, at_s: float) -> float:
        lag, after = stream.seconds - stream.logged, stream.logged >= at_s
        parts = lag[~after][-_AROUND:], lag[after][:_AROUND]
        return float(np.median(parts[1]) - np.median(parts[0])) if all(map(len, parts)) else 0.0

    for at_s in images.logged[_breaks(images)].tolist():
        own, *rest = (step(stream, at_s) for stream in (images, *others))
        if max(map(abs, rest), default=0.0) < 0.5 * abs(own):
            yield own, at_s


def longest_part(images: Stream) -> tuple[int, int]:
    """First and last time of recording, ns, of the longest part whose clock was not set."""
    broken = _breaks(images)
    begins = [0, *images.logged_ns[broken].tolist(), np.iinfo(np.int64).max]
    longest = int(np.diff([0, *broken, len(images)]).argmax())
    return begins[longest], begins[longest + 1] - 1


def clock_hints(images: Stream, others: Mapping[str, Stream]) -> dict[str, list[float]]:
    """
    Start values of the clock offsets of each stream, s, by stamps and times of recording.

    Images get those of all streams, as their clock may be the wrong one.
    """

    def clock_of(stream: Stream) -> tuple[float, bool]:
        offset_s, _, away = _log_clock(stream)
        return offset_s, bool(np.mean(away < _OUT_OF_STEP_S) > _STEADY)

    hints: dict[str, list[float]] = {}
    (own_s, own_steady), begin = clock_of(images), float(images.seconds[0])
    for name, stream in others.items():
        offset_s, steady = clock_of(stream)
        offset = offset_s - own_s if steady and own_steady else 0.0
        hints[name] = [offset, float(stream.seconds[0]) - begin]
    hints[IMAGES] = [offset for offsets in hints.values() for offset in offsets]
    return hints
