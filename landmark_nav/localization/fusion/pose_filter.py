"""
Fusion of bearings with odometry: a Schmidt-Kalman filter that knows when it is lost.

`state` and `measurement` hold the equations, `update` the gates, `mixture` the hypotheses,
`history` the order of time, `health` the verdict, and `recovery` what follows a doubt.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.fusion.bearings import FrameMaker
from landmark_nav.localization.fusion.config import FusionConfig
from landmark_nav.localization.fusion.doubt import doubted_estimate, doubted_state, is_elsewhere
from landmark_nav.localization.fusion.fix import update_pose
from landmark_nav.localization.fusion.fix_sources import FixSources, Seen
from landmark_nav.localization.fusion.health import Health, HealthConfig, Status
from landmark_nav.localization.fusion.history import Ahead, History, Step
from landmark_nav.localization.fusion.late_joints import found_in_swing, REACH_S
from landmark_nav.localization.fusion.mixture import Mixture
from landmark_nav.localization.fusion.recovery import Recovery
from landmark_nav.localization.fusion.start import Found, joints_in_doubt
from landmark_nav.localization.fusion.state import FilterState, initial_state, moved_to, with_map
from landmark_nav.localization.fusion.turn import update_turning
from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.localization.fusion.witnesses import Witnesses
from landmark_nav.localization.joint_delay import JointDelay
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.start import checked_start, is_finite
from landmark_nav.types import (
    Detections,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
    RefusalCode,
)

__all__ = ['PoseFilter']

# Chi-square level of the gate for triangulated poses.
_POSE_PROBABILITY = 0.99
# Late joint states lose landmarks where the pan turns so far meanwhile.
_PAN_RANGE_RAD = 0.035
_BLIND = Refusal(
    'nothing is found any more',
    'joint_states are late, the camera is covered or the robot was moved',
)
_HANGS = Refusal('odometry stands', 'which images do not confirm')


class PoseFilter:
    """
    Pose of ``base_link`` in map, out of odometry and landmarks.

    Parameters
    ----------
    landmark_map : LandmarkMap
        Landmarks with their joint covariance.
    mount : PanTiltMount
        Where the pan axis, the apex of all bearings, sits on the base.

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
        self._lever = np.asarray(mount.axis_xyz[:2], dtype=np.float64)
        self._pan_sigma_rad = mount.pan_sigma_rad
        self._config = config or FusionConfig()
        self._odometry = odometry or OdometryNoiseConfig()
        self._history = History(self._odometry, self._config.history_s)
        self._health = Health(health or HealthConfig())
        self._recovery = Recovery(
            self._history, self._lever, self._config.turn_sigma_rad, self._odometry
        )
        self.change_map(landmark_map)

    @property
    def state(self) -> FilterState | None:
        """The newest state, with the systematic errors; None before `initialize`."""
        return self._history.at() if self._history.started else None

    def reaches(self, stamp_ns: int) -> bool:
        """Whether a start at a time can be moved on to now."""
        reach = self._history.reach_ns
        return reach is None or reach[0] <= stamp_ns

    @property
    def odometry_noise(self) -> OdometryNoiseConfig:
        """How far odometry is to be trusted, as far as it was learned."""
        state = self.state
        return self._odometry if state is None else state.scales.of(self._odometry)

    @property
    def detection_sigma_factor(self) -> float:
        """Factor on what detections claim as their sigmas, as far as it was learned."""
        state = self.state
        return 1.0 if state is None else state.scales.detection_sigma_factor

    @property
    def late(self) -> JointDelay:
        """Of the stamps of the joints, as far as it was measured."""
        return self._history.last.late if self._history.started else JointDelay()

    @property
    def status(self) -> tuple[Status, str]:
        """``tracking``, ``coasting`` or ``lost``, and the reason for the last two."""
        return self.status_at(None)

    def status_at(self, stamp_ns: int | None) -> tuple[Status, str]:
        """`status`, or as it will be at a later time if nothing comes until then."""
        known = self._history.odometry_ns
        if stamp_ns is not None and self._history.started:
            stamp_ns = max(stamp_ns, self._history.newest_ns)
        odometry_ns = None if known is None else known[1]
        status, reason = self._health.status(self.estimate(stamp_ns), odometry_ns)
        if status == 'tracking' and not self._witnesses.vouched:
            return 'coasting', 'the place is not sure: only one wall of the map speaks for it'
        return status, reason

    def initialize(
        self,
        start: PoseEstimate,
        now_ns: int | None = None,
        found: Found | None = None,
    ) -> None:
        """
        Start anew at a pose; only what was learned of robot and camera is kept.

        Parameters
        ----------
        start : PoseEstimate
            Pose of the base in map. A stamp that is not near the odometry of the last seconds
            (RViz on another clock) is taken as now.
        now_ns : int, optional
            Present time; by default that of the last odometry.
        found : Found, optional
            How the pose was found, if it was. It then counts as sure only when landmarks on two
            walls agree with it. If the camera was turning, its joint states may be late, unless
            odometry led to that heading as well.

        Raises
        ------
        LandmarkNavError
            A pose or covariance that is not finite, or a covariance that is not positive.

        """
        # Who gives a pose of long ago is at another clock; a search takes its time.
        known = self._history.reach_ns if found else self._history.recent_odometry_ns
        start = checked_start(start, known, now_ns)
        if self._history.started:
            state = moved_to(self._history.at(start.stamp_ns), start)
        else:
            config = self._config
            sigmas = config.boresight_sigma_rad, config.delay_sigma_s, config.principal_point_sigma
            state = initial_state(start, self._map, self._odometry, *sigmas)
        begin = Mixture((state,))
        self._witnesses = Witnesses(self._map, vouched=found is None)
        if found is not None:
            self._witnesses.found_by(self._frames.columns(found.witnesses))
            reckoned = self._history.dead_reckoned(start.stamp_ns)
            if joints_in_doubt(start, found, state.late, reckoned):
                # A pose measured in the same swing is off by the same angle.
                whole = self._config.mode == 'poses'
                begin = found_in_swing(state, found, self._lever, whole)
        self._history.restart(begin)
        self._recovery.restart()
        self._health.restart(start.stamp_ns)

    def change_map(self, landmark_map: LandmarkMap) -> None:
        """Go on with other landmarks; the pose stays as it is, and as sure."""
        self._map = landmark_map
        self._frames = FrameMaker(landmark_map.ids, self._config, self._pan_sigma_rad)
        self._fix_sources = FixSources(len(landmark_map.landmarks))
        started = self._history.started
        self._witnesses = Witnesses(landmark_map, not started or self._witnesses.vouched)
        if started:
            state = with_map(self._history.at(), landmark_map)
            self._history.restart(Mixture((state,)))
            self._health.change_map()

    def add_odometry(self, sample: OdometrySample) -> Refusal | None:
        """
        Move on.

        Returns
        -------
        Refusal or None
            What was wrong with the sample. It was left out, or used nevertheless if this is
            `Distrusted`.

        """
        refusal = self._history.add_odometry(sample)
        if refusal is not None and refusal.code is RefusalCode.CLOCK_SET_BACK:
            self._health.restart(sample.stamp_ns)
        if refusal is not None and not isinstance(refusal, Ahead):
            self._health.note_trouble(sample.stamp_ns, refusal)
        return refusal

    def add_detections(self, detections: Detections) -> FusionUpdate:
        """Correct by the bearings of one image, at its time."""
        stamp = detections.stamp_ns
        frame = self._frames.frame(detections)
        if (refusal := self._history.untimely(stamp)) is not None:
            self._health.note_refusal(refusal)
            return FusionUpdate(stamp, rejected=frame.unusable, refusal=refusal)
        self._frames.remember(frame.scores)
        missed = self._frames.columns(detections.missed)
        places = self._map.positions[missed]
        expected = len(frame.columns) + len(missed)
        if self._config.mode != 'bearings':
            self._fix_sources.add(Seen(stamp, frame.columns, expected))
            self._health.note_picture(stamp, frame.columns, missed, places)
            return FusionUpdate(stamp, refusal=Refusal('mode is poses', 'bearings are not used'))
        if (refusal := self._health.unusable(frame.scores, expected)) is not None:
            self._health.note_refusal(refusal)
            self._health.note_picture(stamp, frame.columns[:0], missed, places)
            if expected and (since_ns := self._health.blind_since_ns) is not None:
                self._history.doubt_stand(stamp, since_ns)
                self._note_stand(stamp)
                if frame.pan_range_rad(REACH_S) > _PAN_RANGE_RAD:
                    self._history.doubt_joints(stamp)
                    self._health.note_blind(_BLIND)
            return FusionUpdate(stamp, rejected=frame.unusable, refusal=refusal)
        update = self._measure(
            stamp,
            partial(
                update_turning,
                frame=frame,
                lever=self._lever,
                probability=self._health.level(
                    len(frame.columns), self._config.bearing_probability
                ),
                odometry=self._odometry,
                least=self._health.least(expected),
            ),
        )
        # Of bearings that were not used, nothing tells which are the wrong ones.
        elsewhere = len(update.rejected) - len(frame.unusable) if update.degrees else 0
        agree = self._frames.columns(update.accepted_ids)
        self._health.note_picture(stamp, agree, missed, places, elsewhere)
        self._speak(update, agree)
        return update

    def _speak(self, update: FusionUpdate, columns: IndexArray) -> None:
        """Count landmarks that agree as evidence for the place, unless bearings had to turn."""
        if update.turned_rad:
            self._witnesses.contradicted(again=self._health.repeats)
        else:
            self._witnesses.hear(columns)

    def add_pose(self, measured: PoseEstimate) -> FusionUpdate:
        """Correct by a triangulated pose of the base, at its time."""
        stamp = measured.stamp_ns
        if self._config.mode != 'poses':
            return FusionUpdate(stamp, refusal=Refusal('mode is bearings', 'poses are not used'))
        refusal = self._history.untimely(stamp)
        if refusal is None and not is_finite(measured):
            refusal = Refusal('pose is not a number')
        elif refusal is None and (seen := self._fix_sources.picture(stamp)) is not None:
            refusal = self._health.by_chance(len(seen.columns), seen.expected)
        if refusal is not None:
            return self.no_pose(stamp, refusal)
        columns = self._fix_sources.columns(stamp)
        update = self._measure(
            stamp,
            partial(
                update_pose,
                measured=measured,
                columns=columns,
                lever=self._lever,
                probability=_POSE_PROBABILITY,
                turn_sigma=self._config.turn_sigma_rad,
                odometry=self._odometry,
            ),
        )
        if update.degrees:
            self._speak(update, columns)
        return update

    def no_pose(self, stamp_ns: int, refusal: Refusal) -> FusionUpdate:
        """Take note that no pose came of an image, and why."""
        self._health.note_refusal(refusal)
        return FusionUpdate(stamp_ns, refusal=refusal)

    def contradict(self, elsewhere: PoseEstimate, why: str) -> None:
        """Doubt the pose if a search finds one far from it, even if that is not sure itself."""
        here = self.estimate(elsewhere.stamp_ns)
        if here is not None and is_elsewhere(here, elsewhere):
            self._health.doubt(elsewhere.stamp_ns, why)

    def estimate(self, stamp_ns: int | None = None) -> PoseEstimate | None:
        """
        Pose of the base at a time, the newest one by default; None before `initialize`.

        After the last odometry its twist predicts for a short while, then only the covariance
        grows. Before the history begins its first state is given.
        """
        if not self._history.started:
            return None
        return doubted_estimate(self._history.at(stamp_ns).estimate(), self._health.doubts)

    def with_landmarks(self, stamp_ns: int) -> FloatArray:
        """Covariance (3, 2 n) of the pose at a time with x and y of all landmarks."""
        state = self._history.at(stamp_ns)
        return state.map_errors.with_places(state.cross[:3])

    def _measure(self, stamp_ns: int, step: Step) -> FusionUpdate:
        """Apply a measurement at its time, and judge the pose by what became of it."""
        wide = self._health.too_wide(self._history.at(stamp_ns).estimate())
        self._witnesses.note_width(bool(wide))
        if self._health.unseen_s(stamp_ns) > 0.0:
            self._recovery.doubt()
        update = self._history.insert(stamp_ns, step)
        assert update is not None
        self._health.note_update(update)
        self._note_stand(stamp_ns)
        turn_rad = update.turned_rad
        if self._health.astray:
            self._recovery.doubt()
            if update.contradicts:
                self._history.change(stamp_ns, doubted_state)
                self._witnesses.restart(vouched=False)
        elif update.degrees:
            turn_rad = self._recovery.confirm(stamp_ns, turn_rad, self._witnesses.vouched)
        if turn_rad:
            angle = f'{np.degrees(turn_rad):+.2f} deg'
            reason = 'the camera or the robot was turned, wheels slipped or joint_states are late'
            self._health.note_surprise(stamp_ns, Refusal(reason, angle))
        return update

    def _note_stand(self, stamp_ns: int) -> None:
        if self._history.hangs:
            self._health.note_trouble(stamp_ns, _HANGS)
