"""Two sources on one topic: alternating messages that no single motion explains."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray
from landmark_nav.diagnosis.streams import Stream

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
            step = np.where(
                is_angle, np.minimum(step % _TURN_RAD, _TURN_RAD - step % _TURN_RAD), step
            )
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
