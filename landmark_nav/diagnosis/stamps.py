"""Stamps of a stream: rate, gaps, order, and its clock relative to the times of recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from landmark_nav.arrays import FloatArray, IndexArray, IntArray
from landmark_nav.diagnosis.codes import Code
from landmark_nav.diagnosis.findings import Finding, Level
from landmark_nav.diagnosis.motion import Clock
from landmark_nav.diagnosis.streams import IMAGES, JOINTS, ODOMETRY, Stream


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


def clock_hints(images: Stream, others: Mapping[str, Stream]) -> dict[str, list[Clock]]:
    """
    Start values of the clocks of each stream by stamps and times of recording.

    Images get those of all streams, as their clock may be the wrong one.
    """

    def clock_of(stream: Stream) -> tuple[float, bool]:
        offset_s, _, away = _log_clock(stream)
        return offset_s, bool(np.mean(away < _OUT_OF_STEP_S) > _STEADY)

    hints: dict[str, list[Clock]] = {}
    (own_s, own_steady), begin = clock_of(images), float(images.seconds[0])
    for name, stream in others.items():
        offset_s, steady = clock_of(stream)
        offset = offset_s - own_s if steady and own_steady else 0.0
        hints[name] = [Clock(offset), Clock(float(stream.seconds[0]) - begin)]
    hints[IMAGES] = [clock for clocks in hints.values() for clock in clocks]
    return hints
