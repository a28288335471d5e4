"""
The last seconds of a filter: every measurement in its time, whenever it arrives.

Measurements and odometry are kept sorted by stamp, with the state after each. A late measurement
is inserted at its time and everything after it is computed again, so that the result does not
depend on the order of arrival. A measurement newer than the odometry is used at a predicted pose
first, and again when the odometry has come.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from landmark_nav.localization.fusion.late_joints import seen_in_swing
from landmark_nav.localization.fusion.mixture import Mixture
from landmark_nav.localization.fusion.stand import doubted_stand
from landmark_nav.localization.fusion.state import FilterState, measured, POSE, propagate, widened
from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.localization.odometry.clock import Ahead
from landmark_nav.localization.odometry.noise import (
    Motion,
    motion_variances,
    OdometryNoiseConfig,
)
from landmark_nav.localization.odometry.track import Distrusted, HORIZON_S, OdometryTrack
from landmark_nav.types import OdometrySample, Refusal, RefusalCode

__all__ = ['Ahead', 'History', 'Step']

Step = Callable[[Mixture], tuple[Mixture, FusionUpdate | None]]

# Odometry older by this is not late: the clock was set back, or the start pose had another one.
_CLOCK_STEP_NS = 10**9
# So many late samples in a row, in the order of their stamps, also mean that it was set back.
_LATE_IN_A_ROW = 5
# Not every odometry sample gets a state of its own, only the first in each interval of this length
# (counted from 1970, so that it does not depend on when the filter began).
_STRIDE_NS = 100_000_000
# A place may be that of an image of so long ago.
_REACH_NS = 10 * 10**9
# The robot may have moved while the clock was set back.
_BLIND_SECOND = Motion(np.zeros(3), 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class _Event:
    """What happens to the state at a time; `step` is None for odometry alone."""

    stamp_ns: int
    step: Step | None = None


class History:
    """
    States of the last seconds, moved by odometry and changed by steps.

    Parameters
    ----------
    config : OdometryNoiseConfig
        How far odometry is to be trusted.
    span_s : float
        How late a measurement may come.

    """

    def __init__(self, config: OdometryNoiseConfig, span_s: float) -> None:
        self._config = config
        self._span_ns = int(span_s * 1e9)
        self._track = OdometryTrack(config)
        self._events: list[_Event] = []
        self._states: list[Mixture] = []  # after each event
        self._trusted: Mixture | None = None
        self._late_ns = self._late_in_a_row = 0
        self._ahead: OdometrySample | None = None

    @property
    def started(self) -> bool:
        """Whether there is a state, that is, whether `restart` was called."""
        return bool(self._states)

    @property
    def last(self) -> FilterState:
        """The state after the newest event, not moved on to the newest odometry."""
        return self._states[-1].merged()

    @property
    def hangs(self) -> bool:
        """Whether, most likely, the odometry hangs: it stands while the robot moves."""
        return self._states[-1].states[0].hangs

    @property
    def begin_ns(self) -> int:
        """Time before which nothing can be inserted any more."""
        return self._events[0].stamp_ns

    @property
    def newest_ns(self) -> int:
        """Time of the newest event or odometry."""
        known = self._track.stamps_ns
        return max(self._events[-1].stamp_ns, known[1] if known is not None else 0)

    @property
    def odometry_ns(self) -> tuple[int, int] | None:
        """First and last time of the odometry; None while there is none."""
        return self._track.stamps_ns

    @property
    def reach_ns(self) -> tuple[int, int] | None:
        """First and last time from which the odometry leads to now."""
        known = self.odometry_ns
        return None if known is None else (known[0] - round(1e9 * HORIZON_S), known[1])

    @property
    def recent_odometry_ns(self) -> tuple[int, int] | None:
        """`odometry_ns` within the span."""
        known = self.odometry_ns
        return None if known is None else (max(known[0], known[1] - self._span_ns), known[1])

    def untimely(self, stamp_ns: int) -> Refusal | None:
        """Why nothing can be inserted at a time; None if it can."""
        if not self._states:
            return Refusal('not initialized', 'give a start pose')
        late = (self.begin_ns - stamp_ns) * 1e-9
        return Refusal('too late', f'{late:.3f} s before the history') if late > 0.0 else None

    def restart(self, state: Mixture) -> None:
        """Begin anew with its hypotheses; odometry that came after it is kept."""
        self._events = [_Event(state.stamp_ns)]
        # The covariance is that of the given time: a stand before it does not count.
        self._states = [state.each(measured)]
        known = self._track.stamps_ns
        if known is not None:
            first_ns = (state.stamp_ns // _STRIDE_NS + 1) * _STRIDE_NS
            self._events += [_Event(ns) for ns in range(first_ns, known[1], _STRIDE_NS)]
            self._repeat(1)
            self._forget()

    def add_odometry(self, sample: OdometrySample) -> Refusal | None:
        """Move on; what is wrong with the sample, if anything (`Distrusted` if it is used)."""
        known = self._track.stamps_ns
        if known is None and len(self._events) == 1:
            start = self._states[0]
            if abs(sample.stamp_ns - start.stamp_ns) > _REACH_NS:
                # Before any odometry came nobody knew by which clock a start was told.
                self.restart(start.each(lambda one: replace(one, stamp_ns=sample.stamp_ns)))
        if known is not None and sample.stamp_ns - known[1] > _CLOCK_STEP_NS:
            pause = self._after_pause(sample, known[1])
            if pause is not None:
                return pause
        else:
            self._ahead = None
        newest_ns = self._events[-1].stamp_ns if self._events else known[1] if known else 0
        if known is not None and sample.stamp_ns <= known[1]:
            self._late_in_a_row += 1 if sample.stamp_ns > self._late_ns else -self._late_in_a_row
            self._late_ns = sample.stamp_ns
        else:
            self._late_in_a_row = 0
        stepped = self._late_in_a_row >= _LATE_IN_A_ROW
        if stepped or sample.stamp_ns < newest_ns - max(self._span_ns, _CLOCK_STEP_NS):
            self._late_in_a_row = 0
            return self._turn_back(sample, newest_ns)
        refusal = self._track.add(sample)
        if not self._events:
            self._track.trim(sample.stamp_ns - _REACH_NS)
        now_known = self._track.stamps_ns
        if not self._events or now_known is None or now_known == known:
            return refusal
        if sample.stamp_ns > self.begin_ns:
            # States after the previous sample were predicted without this one.
            since = min(known[1], now_known[1]) if known is not None else self.begin_ns
            first = max(1, self._place(since))
            if sample.stamp_ns // _STRIDE_NS != since // _STRIDE_NS:
                self._events.insert(self._place(sample.stamp_ns), _Event(sample.stamp_ns))
            if first < len(self._events):
                self._repeat(first)
        self._forget()
        return refusal

    def _after_pause(self, sample: OdometrySample, last_ns: int) -> Ahead | None:
        """Hold back a sample far ahead; the next one tells whether there was a pause."""
        ahead, self._ahead = self._ahead, sample
        paused = ahead is not None and 0 < sample.stamp_ns - ahead.stamp_ns <= (
            ahead.stamp_ns - last_ns
        )
        if paused:
            self._ahead = None
            return None
        seconds = 1e-9 * (sample.stamp_ns - last_ns)
        return Ahead('odometry is ahead', f'{seconds:.1f} s: the next sample tells')

    def change(self, stamp_ns: int, change: Callable[[FilterState], FilterState]) -> None:
        """Change all states of a time, and repeat what follows."""
        self.insert(stamp_ns, lambda mixture: (mixture.each(change), None))

    def insert(self, stamp_ns: int, step: Step) -> FusionUpdate | None:
        """Apply a step at its time and repeat what follows; what became of the step."""
        place = self._place(stamp_ns)
        self._events.insert(place, _Event(stamp_ns, step))
        update = self._repeat(place)[0]
        self._forget()
        return update

    def doubt_stand(self, stamp_ns: int, blind_since_ns: int) -> None:
        """
        Assume that the robot moved, if landmarks went out of sight while the odometry stood.

        Not if an image was used during that stand: then the fault is the camera's.

        Parameters
        ----------
        stamp_ns : int
            Of the last image.
        blind_since_ns : int
            Of the first image without landmarks.

        """
        stands_ns = self._track.still_since_ns
        if stands_ns is None or stands_ns >= blind_since_ns:
            return
        # `still_s` counts from the last measurement; as long as the stand, if none came in it.
        if self.at(stamp_ns).still_s >= 1e-9 * (stamp_ns - stands_ns) - 1e-6:
            self.change(stamp_ns, partial(doubted_stand, config=self._config))

    def doubt_joints(self, stamp_ns: int) -> None:
        """Assume that the joint states may be late, if landmarks went out of sight in a swing."""
        self.insert(stamp_ns, lambda mixture: (seen_in_swing(mixture), None))

    def at(self, stamp_ns: int | None = None) -> FilterState:
        """
        State at a time, the newest one by default.

        After the last odometry its twist predicts for a short while, then only the covariance
        grows. Before the history begins its first state is given.
        """
        if stamp_ns is None:
            stamp_ns = self.newest_ns
        state = self._states[max(self._place(stamp_ns) - 1, 0)]
        return self._moved(state, max(stamp_ns, state.stamp_ns)).merged()

    def way_m(self, from_ns: int, to_ns: int) -> float:
        """Distance between the places of two times, by odometry."""
        return float(np.hypot(*self._track.motion(from_ns, to_ns).increment[:2]))

    def trust(self, stamp_ns: int) -> None:
        """Start dead reckoning anew, from the state of a time."""
        self._trusted = self._states[max(self._place(stamp_ns) - 1, 0)]

    def dead_reckoned(self, stamp_ns: int) -> FilterState | None:
        """State of a time by odometry alone since the last `trust`; None if there was none."""
        if self._trusted is None or self._trusted.stamp_ns > stamp_ns:
            return None
        return self._moved(self._trusted, stamp_ns).merged()

    def _place(self, stamp_ns: int) -> int:
        return bisect_right(self._events, stamp_ns, key=lambda event: event.stamp_ns)

    def _moved(self, state: Mixture, stamp_ns: int) -> Mixture:
        if stamp_ns == state.stamp_ns:
            return state
        motion = self._track.motion(state.stamp_ns, stamp_ns)
        return self._propagated(state, stamp_ns, motion)

    def _propagated(self, state: Mixture, stamp_ns: int, motion: Motion) -> Mixture:
        return state.each(lambda one: propagate(one, stamp_ns, motion, self._config))

    def _repeat(self, first: int) -> list[FusionUpdate | None]:
        """
        Compute the states from event `first` on; return the updates of these events.

        An event that fails is left out before its error is raised: what else is known stays.
        """
        events, self._events = self._events[first:], self._events[:first]
        del self._states[first:]
        updates: list[FusionUpdate | None] = []
        failure: Exception | None = None
        for event in events:
            try:
                state, update = self._moved(self._states[-1], event.stamp_ns), None
                if event.step is not None:
                    state, update = event.step(state)
            except Exception as error:
                failure = error
                continue
            self._events.append(event)
            self._states.append(state)
            updates.append(update)
        if failure is not None:
            raise failure
        return updates

    def _forget(self) -> None:
        """Drop events older than the span, all but the last of them."""
        drop = self._place(self._events[-1].stamp_ns - self._span_ns) - 1
        if drop > 0:
            del self._events[:drop], self._states[:drop]
            if self._trusted is not None and self._trusted.stamp_ns < self.begin_ns:
                self._trusted = self._moved(self._trusted, self.begin_ns)
            self._track.trim(self.begin_ns - _REACH_NS)

    def _turn_back(self, sample: OdometrySample, last_ns: int) -> Refusal:
        """Go on from the newest state after the clock was set back (a bag that starts over)."""
        self._track = OdometryTrack(self._config)
        self._track.add(sample)
        self._trusted = None
        if self._states:
            moved = widened(self.last, POSE, motion_variances(_BLIND_SECOND, self._config))
            self.restart(Mixture((replace(moved, stamp_ns=sample.stamp_ns),)))
        return Distrusted(
            'clock was set back',
            f'{(last_ns - sample.stamp_ns) * 1e-9:.1f} s: goes on from the last pose',
            RefusalCode.CLOCK_SET_BACK,
        )
