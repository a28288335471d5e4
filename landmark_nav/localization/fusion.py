"""
Fusion of bearings with odometry: a Schmidt-Kalman filter that puts every measurement in its time.

A short history of what came in is kept, sorted by stamp, with the state after each. What comes
late is inserted and all after it is repeated, so the result does not depend on the order of
arrival. A measurement newer than the odometry is first used where the last twist leads, then
again where the odometry says.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.fusion_health import Health, HealthConfig, Status
from landmark_nav.localization.fusion_state import FilterState, initial_state, propagate
from landmark_nav.localization.fusion_update import (
    BearingFrame,
    FusionUpdate,
    update_bearings,
    update_pose,
)
from landmark_nav.localization.odometry_noise import Motion, motion_variances, OdometryNoiseConfig
from landmark_nav.localization.odometry_track import OdometryTrack
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import Detections, LandmarkMap, OdometrySample, PoseEstimate, Refusal

__all__ = ['FusionConfig', 'FusionUpdate', 'PoseFilter']

# What may have happened while the clock was set back.
_BLIND_SECOND = Motion(np.zeros(3), 1.0, 1.0)

Step = Callable[[FilterState], tuple[FilterState, FusionUpdate | None]]


@dataclass(frozen=True)
class FusionConfig:
    """What the filter takes and how strictly."""

    mode: str = parameter(
        'bearings',
        'What corrects the odometry: every bearing by itself, or triangulated poses.',
        choices=('bearings', 'poses'),
    )
    landmarks: str = parameter(
        'consider',
        'Landmark errors: carried along, so that the map is all that is ever claimed, or refined '
        'by what is seen.',
        choices=('consider', 'refine'),
    )
    bearing_probability: float = parameter(
        0.999, 'Chi-square level of the gates for bearings.', minimum=0.5, maximum=1.0
    )
    pose_probability: float = parameter(
        0.99, 'Chi-square level of the gate for poses.', minimum=0.5, maximum=1.0
    )
    pan_sigma_rad: float = parameter(
        2e-4, 'Error of the pan angle, common to one picture, rad.', minimum=0.0, maximum=1.0
    )
    boresight_sigma_rad: float = parameter(
        0.0,
        'Sigma of a constant offset of all bearings that is estimated; 0 takes it as known.',
        minimum=0.0,
        maximum=1.0,
    )
    history_s: float = parameter(
        2.0, 'How late a measurement may come, s.', minimum=0.0, maximum=60.0
    )
    astray_sigma_m: float = parameter(
        0.15, 'Position noise added with each rejection while lost, m.', minimum=0.0, maximum=10.0
    )
    astray_sigma_rad: float = parameter(
        0.05, 'Heading noise added with each rejection while lost, rad.', minimum=0.0, maximum=3.0
    )
    astray_limit_m: float = parameter(
        2.0, 'Position sigma at which that ends, m.', minimum=0.0, maximum=100.0
    )

    def __post_init__(self) -> None:
        """Check the values."""
        check_parameters(self)


@dataclass(frozen=True, eq=False)
class _Event:
    """What happens to the state at a time; `step` is None for odometry alone."""

    stamp_ns: int
    step: Step | None = None


class PoseFilter:
    """
    Pose of ``base_link`` in map, out of odometry and landmarks.

    Parameters
    ----------
    landmark_map : LandmarkMap
        Landmarks with their joint covariance.
    mount : PanTiltMount
        Where the pan axis, the apex of all bearings, sits on the base.
    config, odometry, health : optional
        Parameters.

    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        mount: PanTiltMount,
        config: FusionConfig | None = None,
        odometry: OdometryNoiseConfig | None = None,
        health: HealthConfig | None = None,
    ) -> None:
        """Wait for `initialize`."""
        self._map = landmark_map
        self._lever = np.asarray(mount.axis_xyz[:2], dtype=np.float64)
        self._config = config or FusionConfig()
        self._odometry = odometry or OdometryNoiseConfig()
        self._track = OdometryTrack(self._odometry)
        self._health = Health(health or HealthConfig())
        self._column = {int(k): i for i, k in enumerate(landmark_map.ids)}
        self._events: list[_Event] = []
        self._states: list[FilterState] = []  # after each event

    @property
    def state(self) -> FilterState | None:
        """The newest state, with the systematic errors; None before `initialize`."""
        return self._states[-1] if self._states else None

    @property
    def status(self) -> tuple[Status, str]:
        """``tracking``, ``coasting`` or ``lost``, and the reason for the last two."""
        return self._health.status(self.estimate())

    def initialize(self, start: PoseEstimate) -> None:
        """
        Start anew at a pose; what was measured before its time no longer counts.

        A stamp outside the odometry of the last seconds (RViz on another clock) is taken as now.

        Raises
        ------
        LandmarkNavError
            A pose or covariance that is not finite, or a covariance that is not positive.

        """
        if not (np.isfinite(start.pose).all() and np.isfinite(start.covariance).all()):
            raise LandmarkNavError('start pose: x, y, heading or covariance is not a number')
        if np.linalg.eigvalsh(start.covariance)[0] < -1e-9:
            raise LandmarkNavError('start pose: its covariance is not positive semidefinite')
        known = self._track.stamps_ns
        if known is not None and not known[0] <= start.stamp_ns <= known[1] + 10**9:
            start = replace(start, stamp_ns=known[1])
        state = initial_state(start, self._map, self._odometry, self._config.boresight_sigma_rad)
        self._events = [_Event(start.stamp_ns)]
        self._states = [state]
        self._health.restart(start.stamp_ns)
        if known is not None and known[1] > start.stamp_ns:
            self._insert(_Event(known[1]))

    def add_odometry(self, sample: OdometrySample) -> Refusal | None:
        """
        Move on.

        Returns
        -------
        Refusal or None
            What was wrong with the sample; the filter goes on without it.

        """
        known = self._track.stamps_ns
        if known is not None and sample.stamp_ns < known[1] - int(self._config.history_s * 1e9):
            return self._restart_clock(sample)
        refusal = self._track.add(sample)
        if not self._states or self._track.stamps_ns == known:
            return refusal
        # What was predicted since the sample before is now known better.
        since = known[1] if known is not None else sample.stamp_ns
        if sample.stamp_ns > self._events[0].stamp_ns:
            self._insert(_Event(sample.stamp_ns), repeat_after_ns=since)
        self._forget()
        return refusal

    def add_detections(self, detections: Detections) -> FusionUpdate:
        """Correct by the bearings of one picture, at its time."""
        stamp = detections.stamp_ns
        if self._config.mode != 'bearings':
            return FusionUpdate(stamp, refusal=Refusal('mode is poses', 'bearings are not used'))
        frame = self._frame(detections)
        refusal = self._untimely(stamp)
        if refusal is None and not len(frame.columns):
            refusal = Refusal('no usable bearing')
        if refusal is not None:
            self._health.note(refusal)
            return FusionUpdate(stamp, rejected=frame.unusable, refusal=refusal)
        return self._measure(
            stamp,
            partial(
                update_bearings,
                frame=frame,
                ids=self._map.ids,
                lever=self._lever,
                probability=self._config.bearing_probability,
                least=3 if self._health.astray else 1,
                refine=self._config.landmarks == 'refine',
            ),
        )

    def add_pose(self, measured: PoseEstimate) -> FusionUpdate:
        """Correct by a triangulated pose of the base, at its time."""
        stamp = measured.stamp_ns
        if self._config.mode != 'poses':
            return FusionUpdate(stamp, refusal=Refusal('mode is bearings', 'poses are not used'))
        refusal = self._untimely(stamp)
        if refusal is None and not (
            np.isfinite(measured.pose).all() and np.isfinite(measured.covariance).all()
        ):
            refusal = Refusal('pose is not a number')
        if refusal is not None:
            self._health.note(refusal)
            return FusionUpdate(stamp, refusal=refusal)
        level = self._config.pose_probability
        return self._measure(stamp, partial(update_pose, measured=measured, probability=level))

    def estimate(self, stamp_ns: int | None = None) -> PoseEstimate | None:
        """
        Pose of the base at a time, the newest one by default; None before `initialize`.

        Beyond the last odometry its twist predicts for a short while, then only the covariance
        grows. Before the history begins its first state is given.
        """
        if not self._states:
            return None
        if stamp_ns is None:
            return self._states[-1].estimate()
        place = max(bisect_right(self._events, stamp_ns, key=lambda e: e.stamp_ns) - 1, 0)
        state = self._states[place]
        return self._moved(state, max(stamp_ns, state.stamp_ns)).estimate()

    def _restart_clock(self, sample: OdometrySample) -> Refusal:
        """Go on from the newest state where time has gone back (a bag that starts over)."""
        last = self._track.stamps_ns
        assert last is not None
        self._track = OdometryTrack(self._odometry)
        self._track.add(sample)
        if self._states:
            covariance = self._states[-1].covariance.copy()
            covariance[:3, :3] += np.diag(motion_variances(_BLIND_SECOND, self._odometry))
            self._states = [
                replace(self._states[-1], stamp_ns=sample.stamp_ns, covariance=covariance)
            ]
            self._events = [_Event(sample.stamp_ns)]
            self._health.restart(sample.stamp_ns)
        return Refusal(
            'odometry went back in time',
            f'{(last[1] - sample.stamp_ns) * 1e-9:.1f} s: goes on from the last pose',
        )

    def _untimely(self, stamp_ns: int) -> Refusal | None:
        if not self._states:
            return Refusal('not initialized', 'give a start pose')
        begin = self._events[0].stamp_ns
        if stamp_ns < begin:
            return Refusal('too late', f'{(begin - stamp_ns) * 1e-9:.3f} s before the history')
        return None

    def _frame(self, detections: Detections) -> BearingFrame:
        """Sort out what no filter can use."""
        unusable: dict[int, Refusal] = {}
        chosen: list[int] = []
        good = np.isfinite(detections.bearing_rad) & (detections.variance_rad2 > 0.0)
        good &= np.isfinite(detections.variance_rad2)
        taken: set[int] = set()
        for k, landmark in enumerate(detections.ids.tolist()):
            if landmark not in self._column:
                unusable[landmark] = Refusal('not in the map')
            elif not good[k]:
                unusable[landmark] = Refusal('bearing or variance is not a number')
            elif landmark in taken:
                unusable[landmark] = Refusal('given twice')
            else:
                taken.add(landmark)
                chosen.append(k)
        columns = np.array([self._column[int(detections.ids[k])] for k in chosen], dtype=np.intp)
        noise = np.diag(detections.variance_rad2[chosen]) + self._config.pan_sigma_rad**2
        return BearingFrame(columns, detections.bearing_rad[chosen], noise, unusable)

    def _measure(
        self, stamp_ns: int, step: Callable[[FilterState], tuple[FilterState, FusionUpdate]]
    ) -> FusionUpdate:
        update = self._insert(_Event(stamp_ns, step))
        assert update is not None
        self._health.observe(update)
        if self._health.astray and update.refusal is not None:
            self._insert(_Event(stamp_ns, self._doubted))
        self._forget()
        return update

    def _doubted(self, state: FilterState) -> tuple[FilterState, None]:
        """Widen a state that measurements keep contradicting, until they can fit again."""
        covariance = state.covariance.copy()
        if np.trace(covariance[:2, :2]) < self._config.astray_limit_m**2:
            covariance[0, 0] += self._config.astray_sigma_m**2
            covariance[1, 1] += self._config.astray_sigma_m**2
            covariance[2, 2] += self._config.astray_sigma_rad**2
        return replace(state, covariance=covariance), None

    def _moved(self, state: FilterState, stamp_ns: int) -> FilterState:
        if stamp_ns == state.stamp_ns:
            return state
        motion = self._track.motion(state.stamp_ns, stamp_ns)
        return propagate(state, stamp_ns, motion, self._odometry)

    def _insert(self, event: _Event, repeat_after_ns: int | None = None) -> FusionUpdate | None:
        """Put an event in its place and repeat what follows; what became of the event."""
        place = bisect_right(self._events, event.stamp_ns, key=lambda e: e.stamp_ns)
        self._events.insert(place, event)
        first = place
        if repeat_after_ns is not None:
            after = bisect_right(self._events, repeat_after_ns, key=lambda e: e.stamp_ns)
            first = max(1, min(place, after))
        del self._states[first:]
        update = None
        for k in range(first, len(self._events)):
            state = self._moved(self._states[-1], self._events[k].stamp_ns)
            step = self._events[k].step
            if step is not None:
                state, happened = step(state)
                update = happened if k == place else update
            self._states.append(state)
        return update

    def _forget(self) -> None:
        """Drop events older than the history, all but the last of them."""
        oldest = self._events[-1].stamp_ns - int(self._config.history_s * 1e9)
        drop = bisect_right(self._events, oldest, key=lambda e: e.stamp_ns) - 1
        if drop > 0:
            del self._events[:drop], self._states[:drop]
            self._track.trim(self._events[0].stamp_ns)
