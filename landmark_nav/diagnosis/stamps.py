"""Stamps of a stream: rate, gaps, order, and its clock relative to the times of recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from landmark_nav.arrays import FloatArray, IndexArray, IntArray
from landmark_nav.diagnosis.advice import seconds_text
from landmark_nav.diagnosis.findings import Finding, Level
from landmark_nav.diagnosis.motion import Clock
from landmark_nav.diagnosis.streams import Stream


class _Need(NamedTuple):
    """Least rate, Hz, and longest gap, s, with which localization keeps its accuracy."""

    rate_hz: float
    gap_s: float
    what: str


_NEEDS = {
    'images': _Need(1.0, 2.0, 'the camera'),
    'joint_states': _Need(10.0, 0.5, 'the driver of the joints'),
    'odom': _Need(5.0, 1.5, 'the odometry'),
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


class LogClock(NamedTuple):
    """
    Stamps relative to times of recording: offset at the start, s, and drift as a share.

    `steady` is whether most messages lie on that line.
    """

    offset_s: float
    drift: float
    steady: bool


def check_stamps(stream: Stream) -> list[Finding]:
    """Check rate, gaps, order, duplicates and zeros of the stamps of one stream."""
    name, n = stream.name, len(stream)
    need = _NEEDS.get(name, _Need(0.0, np.inf, 'the publisher'))
    found = []
    if refused := stream.refused:
        level: Level = 'warning' if n else 'error'
        text, values = f'{refused} of {n + refused} messages cannot be used', {'refused': refused}
        values['messages'] = n + refused
        kind = f'{name} values', level, text, stream.why, values
        found.append(Finding(*kind, when_read=True))
    if n < 2:
        return found or [Finding(f'{name} rate', 'warning', f'{n} messages', 'record more')]
    if zeros := stream.unstamped:
        text = f'{"all" if zeros == n else f"{zeros} of {n}"} stamps are 0: the time of recording '
        advice = f'{need.what} must stamp {name} (header.stamp)'
        values = {'zeros': zeros, 'messages': n}
        found.append(Finding(f'{name} stamps', 'warning', f'{text}is used', advice, values))
    found += _nanosec_unit(stream)
    steps = np.diff(stream.seconds)
    period = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    rate_hz = 1.0 / period if period else 0.0
    slow = rate_hz < 0.95 * need.rate_hz
    text, advice = (
        f'{rate_hz:.1f} Hz, {n} messages',
        f'publish {name} at {need.rate_hz:g} Hz or more',
    )
    rated, level = {'rate_hz': rate_hz, 'messages': n}, 'warning' if slow else 'ok'
    found.append(Finding(f'{name} rate', level, text, advice if slow else '', rated))
    longest, longest_s = int(steps.argmax()), float(steps.max())
    if longest_s > max(need.gap_s, 5.0 * period):
        at_s, until_s = (stream.logged[longest : longest + 2] - stream.logged[0]).tolist()
        text = f'none for {longest_s:.2f} s at {at_s:.1f} s'
        advice = f'localization takes {need.gap_s:g} s: look at {need.what} and the recorder'
        if until_s - at_s < 0.5 * longest_s:
            text = f'stamps go forward by {longest_s:.4g} s at {at_s:.1f} s, recording does not'
            advice = 'its clock was set: set clocks before nodes start, by NTP or chrony'
        gap = {'longest_s': longest_s, 'at_s': at_s}
        found.append(Finding(f'{name} gaps', 'warning', text, advice, gap))
    return [*found, *_jitter(stream, need.what), *_order(stream, steps)]


def _jitter(stream: Stream, what: str) -> list[Finding]:
    """Find jitter of stamps of messages that arrive evenly."""
    steps = np.diff([stream.seconds - stream.logged, stream.logged])
    away = np.abs(steps - np.median(steps, axis=1, keepdims=True))
    # The quantile ignores a step of the clock, but not errors of one message in five.
    jitter_s, arrival_s = (np.quantile(away, 0.9, axis=1) / _NORMAL_90).tolist()
    if jitter_s < _JITTER_S or arrival_s > 0.5 * jitter_s:
        return []
    text = f'stamps jitter by {seconds_text(jitter_s)}, messages arrive within '
    text += seconds_text(arrival_s)
    advice = f'{what} must stamp {stream.name} at the time of measurement'
    values = {'stamps_s': jitter_s, 'arrival_s': arrival_s}
    return [Finding(f'{stream.name} jitter', 'warning', text, advice, values)]


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
    if not wrong:
        return None
    text = f'{", ".join(wrong)} in a wrong order: by their stamps, which are even, times of '
    text += f'recording are off by {max(wrong.values()):.1f} s'
    advice = 'record again with one recorder, or convert with the stamps as times of recording'
    return Finding('recording order', 'error', text, advice, {'off_s': max(wrong.values())})


def _nanosec_unit(stream: Stream) -> list[Finding]:
    """Find stamps whose nanoseconds are in a larger unit."""
    most = int((stream.stamps_ns % 1_000_000_000).max())
    # With several messages per second, some have large nanoseconds; whole seconds are rounded.
    often = np.median(np.diff(stream.logged)) < 0.5 and len(stream) > _LEAST_MESSAGES
    if not (often and 0 < most < 1_000_000):
        return []
    unit = 'milliseconds' if most < 1_000 else 'microseconds'
    text = f'no stamp lies over {most} ns after a full second: nanosec counts {unit}'
    advice = 'put nanoseconds into header.stamp.nanosec'
    return [Finding(f'{stream.name} stamps', 'error', text, advice, {'most_ns': most})]


def _order(stream: Stream, steps: FloatArray) -> list[Finding]:
    """Find stamps that come twice or go back, by the steps (n - 1,) between them."""
    same, back, furthest_s = int((steps == 0.0).sum()), int((steps < 0.0).sum()), -steps.min()
    if not (same or back):
        return []
    many = same + back > _OFTEN * len(stream)
    text, advice = f'{same} stamps come twice, {back} out of order', ''
    if furthest_s > _SET_BACK_S:
        many, text = True, f'stamps go back {back} times, by {furthest_s:.1f} s at most'
        advice = 'its clock was set back, or two sources send: one clock, one source'
    elif many:
        advice = 'each message needs the time of its measurement'
    values = {'duplicates': same, 'backward': back, 'backward_s': max(float(furthest_s), 0.0)}
    return [Finding(f'{stream.name} order', 'warning' if many else 'ok', text, advice, values)]


def by_arrival(stream: Stream) -> Stream:
    """Replace stamps that are rounded or jitter by times of recording with their clock."""
    if len(stream) < _LEAST_MESSAGES or not (stream.stamps_ns.any() and np.ptp(stream.logged)):
        return stream
    same = np.mean(np.diff(stream.stamps_ns) == 0)
    if same < _REPEATED and not _jitter(stream, ''):
        return stream
    lag = stream.seconds - stream.logged
    (drift, offset_s), covariance = np.polyfit(stream.logged, lag, 1, cov=True)
    if abs(drift) < _DRIFT_SIGMAS * np.sqrt(covariance[0, 0]):
        drift, offset_s = 0.0, float(np.median(stream.seconds - stream.logged))
    late_ns = np.round(1e9 * (drift * stream.logged + offset_s)).astype(np.int64)
    return replace(stream, stamps_ns=stream.logged_ns + late_ns)


def log_clock(stream: Stream) -> LogClock:
    """Fit a robust line of stamps over times of recording (after Theil and Sen)."""
    lag = stream.seconds - stream.logged
    third = max(len(lag) // 3, 1)
    apart = float(np.median(stream.logged[-third:]) - np.median(stream.logged[:third]))
    rise = float(np.median(lag[-third:]) - np.median(lag[:third]))
    drift = rise / apart if apart > 0.0 else 0.0
    rest = lag - drift * stream.logged
    offset = float(np.median(rest))
    steady = bool(np.mean(np.abs(rest - offset) < _OUT_OF_STEP_S) > _STEADY)
    return LogClock(offset, drift, steady)


def in_step(stream: Stream) -> Stream:
    """Return the messages whose stamps follow the clock of the majority."""
    clock = log_clock(stream)
    away = np.abs(stream.seconds - stream.logged * (1.0 + clock.drift) - clock.offset_s)
    keep = away < max(_OUT_OF_STEP_S, 6.0 * float(np.median(away)))
    return stream if keep.all() else stream.only(keep)


def _breaks(images: Stream) -> IndexArray:
    """Images, by number, before which stamps go back or pause."""
    steps = np.diff(images.seconds)
    return np.flatnonzero((steps < -_SET_BACK_S) | (steps > _PAUSE_S)) + 1


def lone_steps(images: Stream, others: Sequence[Stream]) -> Iterator[tuple[float, float]]:
    """Yield steps of the clock of the images that no other stream has, s, and their times, s."""
    for at_s in images.logged[_breaks(images)].tolist():
        own, *rest = (_step(stream, at_s) for stream in (images, *others))
        if max(map(abs, rest), default=0.0) < 0.5 * abs(own):
            yield own, at_s


def _step(stream: Stream, at_s: float) -> float:
    """Step of a clock against the times of recording, s, at a time of recording."""
    lag, after = stream.seconds - stream.logged, stream.logged >= at_s
    parts = lag[~after][-_AROUND:], lag[after][:_AROUND]
    return float(np.median(parts[1]) - np.median(parts[0])) if all(map(len, parts)) else 0.0


def longest_part(images: Stream) -> tuple[int, int]:
    """First and last time of recording, ns, of the longest part whose clock was not set."""
    broken = _breaks(images)
    begins = [int(images.logged_ns[0]), *images.logged_ns[broken].tolist()]
    ends = [*(begin - 1 for begin in begins[1:]), np.iinfo(np.int64).max]
    if len(begins) == 1:
        return 0, ends[0]
    counts = np.diff([0, *broken, len(images)])
    return begins[int(counts.argmax())], ends[int(counts.argmax())]


def clock_hints(images: Stream, others: Mapping[str, Stream]) -> dict[str, list[Clock]]:
    """
    Start values of the clocks of each stream by stamps and times of recording.

    Images get those of all streams, as their clock may be the wrong one.
    """
    begin, by_images = float(images.seconds[0]), log_clock(images)
    extent = float(np.ptp(images.seconds))
    hints: dict[str, list[Clock]] = {}
    for name, stream in others.items():
        by_log = log_clock(stream)
        drift = (1.0 + by_log.drift) / max(1.0 + by_images.drift, 1e-9) - 1.0
        known = by_log.steady and by_images.steady
        offset = by_log.offset_s - by_images.offset_s if known else 0.0
        start = float(stream.seconds[0]) - begin
        longer = float(np.ptp(stream.seconds)) / extent - 1.0 if extent > 0.0 else 0.0
        drifting = Clock(offset, drift, by_images.offset_s), Clock(start, longer, begin)
        hints[name] = [Clock(offset), Clock(start), *drifting]
    hints['images'] = [clock for clocks in hints.values() for clock in clocks]
    return hints
