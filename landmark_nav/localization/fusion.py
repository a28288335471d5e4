"""Fusion of odometry, detections and found places in the estimator."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
import logging
from math import hypot, log, sqrt

import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.geometry.angles import PanTrack
from landmark_nav.geometry.se2 import compose, inverse
from landmark_nav.localization.estimator.config import EstimatorConfig
from landmark_nav.localization.estimator.factors import ImagePoints, SCALE
from landmark_nav.localization.estimator.filter import JointFilter
from landmark_nav.localization.estimator.integrity import (
    Integrity,
    is_unknown,
    protection_level,
    ProtectionLevel,
    Status,
)
from landmark_nav.localization.estimator.state import State, Update
from landmark_nav.localization.estimator.timeline import move_to, REACH_NS, Timeline
from landmark_nav.localization.joint_delay import DELAY_BOUND_S, JointDelay
from landmark_nav.localization.odometry.noise import Motion, OdometryNoiseConfig
from landmark_nav.localization.odometry.track import (
    ClockStep,
    ClockWatch,
    Distrusted,
    HORIZON_S,
    OdometryTrack,
)
from landmark_nav.localization.start import checked_start, is_prior_uncertain
from landmark_nav.types import (
    CameraFrame,
    Detections,
    Expectation,
    FloatArray,
    JointSample,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)

_LOG = logging.getLogger(__name__)
# Motion while a clock was set back: unknown, as in one second without odometry.
_BLIND_SECOND = Motion(np.zeros(3), 1.0, blind_seconds=1.0)
# A turn of the camera is logged if there was none for this time: a wrong joint gives one an image.
_AGAIN_NS = 10 * 10**9
# Missing odometry is reported after this time, s.
_SILENT_S = 0.7
# Sigmas of changes of the mount since its prior; a change of 5 sigma is a contradiction.
_MAY_STEP = {
    'axis_yaw': 0.03,
    'camera_roll': 0.03,
    'camera_tilt': 0.03,
    'focal_scale': 0.1,
    'joint_delay': DELAY_BOUND_S,
}
# Sigmas by which images contradict a value of the prior, so that poses are wrong with it.
_CONTRADICTION = 5.0
# Sigmas by which ways by odometry and in the map differ, so that one of both is wrong.
_SCALE_SIGMAS = 3.0
# What was moved by less may be a landmark that was learned inexactly: nobody has to learn again.
_MOVED_M = 0.03
# Log odds above which an OK pose is certainly right: what was estimated by then is kept.
_TRUSTED = 4.0
# Prior log odds that a given start is right: one in a hundred is another place.
_GIVEN_RIGHT = log(99.0)
_NO_LANDMARKS = 'no landmarks: call learn_landmarks or load_map'
_OTHER_MAP = 'no landmark of the new map found yet, whose frame may be another'
_NO_POSE = 'no pose yet: odom and images give it, or initialpose'
_NOT_STARTED = Refusal('not initialized', 'give a start pose')
_WRONG_START = Refusal('the given start is wrong', 'images are not those of that place')


class Fusion:
    """
    Estimates pose, calibration and map errors from inputs in any order; offline and in the node.

    Parameters
    ----------
    landmark_map : LandmarkMap
        Landmarks with their joint covariance.
    calibration : Calibration
        Prior of mount, lens and clocks.
    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        calibration: Calibration,
        config: EstimatorConfig | None = None,
        odometry: OdometryNoiseConfig | None = None,
    ) -> None:
        self._map, self.robot, self._prior = landmark_map, calibration, calibration
        self._may_be = calibration.widened(_MAY_STEP)
        self._config = config or EstimatorConfig()
        self._odometry = odometry or OdometryNoiseConfig()
        self._track, self._clock = OdometryTrack(self._odometry), ClockWatch()
        self._line: Timeline | None = None
        # A given start is tested until images alone give the pose: a filter with an unknown pose
        # from there on, the state at the start, and the log odds that the start is right.
        self._anywhere: JointFilter | None = None
        self._given: State | None = None
        self._start_odds = _GIVEN_RIGHT
        # The last state in which the pose was certainly right.
        self._trusted: State | None = None
        self.used_image = False  # for an update
        # Values of the mount that contradict their prior.
        self._unlikely: tuple[str, ...] = ()
        self._integrity, self._update = Integrity(), None  # type: Integrity, Update | None
        # Whether the pose may be in the frame of another map.
        self._elsewhere = False
        self._changed_camera = False  # whether that was logged
        self._turned_ns = -_AGAIN_NS

    def change_map(self, landmark_map: LandmarkMap) -> None:
        """
        Continue with other landmarks; the pose and its covariance are kept.

        Until an image was used, what learning showed of the robot is the prior. A map without a
        landmark of the one before may have another frame: then the pose is lost until images
        confirm it. The same map again changes nothing.
        """
        before, self._map = self._map, landmark_map
        if landmark_map.same_as(before):
            return
        if not self.used_image:
            self._prior = landmark_map.calibration_from(self.robot)
            self._may_be = self._prior.widened(_MAY_STEP)
            self._change(lambda joint: self._new_filter(self._prior, joint.estimate))
            return
        self._prior = replace(self._prior, by_map=None)
        self._change(lambda joint: joint.on_map(landmark_map))
        if landmark_map.landmarks and before.landmarks and not landmark_map.shares_with(before):
            self._integrity, self._elsewhere = Integrity(), True

    def initialize(self, start: PoseEstimate, now_ns: int | None = None) -> None:
        """
        Restart at a given pose; estimates of the robot are kept.

        A stamp that is not near the odometry of the last seconds is replaced by now: `now_ns` or
        the last odometry.

        Raises `LandmarkNavError`: the pose or covariance is not finite, or the covariance is not
        positive semidefinite.
        """
        ends = self._track.stamps_ns
        recent = ends and (max(ends[0], ends[1] - round(1e9 * self._config.history_s)), ends[1])
        self._place(checked_start(start, recent, now_ns))
        self._test_start()

    def place(self, found: PoseEstimate, joints: JointSample | CameraFrame | None = None) -> None:
        """
        Continue at a place found in images; the last of them was taken at these joints.

        Odometry must reach its stamp. Raises `LandmarkNavError`: as `initialize`.
        """
        found = checked_start(found)
        late = self._prior_late if self._line is None else self.late
        rate, bend = 0.0, 0.0
        if joints is not None:
            mount, track = self._prior.base, joints.pan_track
            rate = mount.pan_sense * joints.pan_rate_rad_s
            if track is not None and late.sigma_s:
                azimuth = PanTrack(track.seconds, mount.azimuth_base_rad(track.pans_rad))
                rate, bend = azimuth.lagged(late.delay_s, late.sigma_s)
            bend = hypot(bend, joints.pan_sigma_rad)
        # The pan may begin to turn meanwhile, or between joint states.
        bent = np.diag([0.0, 0.0, bend**2])
        back = self._track.motion_back(found.stamp_ns, self._prior.base.image_delay_s)
        pose = compose(found.pose, inverse(back))
        found = replace(found, pose=pose, covariance=found.covariance + bent)
        self._place(found, rate)

    def use_camera(self, intrinsics: FloatArray | None) -> None:
        """
        Take note of the intrinsics by camera_info (None: unknown) before an image is used.

        If they are not those at learning, or change while driving, what was learned of the lens is
        less certain by the change, or forgotten: `Calibration.for_camera`.
        """
        if intrinsics is None:
            return
        # The robot file of a calibration that came from the map is that at learning.
        robot, before = self.robot, self._prior
        given, known = robot if robot.intrinsics is None else self._map.prior or robot, intrinsics
        self._prior = before.for_camera(known, given)
        if self._prior is before or before.intrinsics is None:
            return
        if not self._changed_camera:
            off = 100.0 * float(np.abs(before.intrinsics - intrinsics).max())
            _LOG.warning(
                'camera_info has changed by %.2g %%: what was learned of the lens is less '
                'certain: publish one calibration, that of learning',
                off,
            )
        self._changed_camera, self._may_be = True, self._prior.widened(_MAY_STEP)

        def changed(joint: JointFilter) -> JointFilter:
            lens = replace(joint.calibration, intrinsics=before.intrinsics)
            return joint.with_lens(lens.for_camera(known, given))

        self._change(changed)

    def reaches(self, stamp_ns: int) -> bool:
        """Whether odometry leads from a time to now, or may still come up to it."""
        ends = self._track.stamps_ns
        early_ns = round(1e9 * HORIZON_S)
        return ends is None or ends[0] - early_ns <= stamp_ns <= ends[1] + REACH_NS

    def add_odometry(self, sample: OdometrySample) -> Refusal | None:
        """Add odometry; return what is wrong with it, if anything (`Distrusted` if it is used)."""
        line, ends, stamp = self._line, self._track.stamps_ns, sample.stamp_ns
        if ends is not None:
            step = self._clock.judge(stamp, ends[1], round(1e9 * self._config.history_s))
            seconds = f'{1e-9 * (stamp - ends[1]):+.1f} s'
            if step is ClockStep.OFF:
                return Refusal('odometry is off', f'{seconds}: the next sample tells')
            if step is ClockStep.BACK:
                self._set_back(sample)
                return Distrusted('clock was set back', f'{seconds}: goes on from the last pose')
        elif line is not None and abs(stamp - line.newest_ns) > REACH_NS:
            # Without odometry, the clock of the start was unknown.
            self._begin(_restamped(line.filter, stamp))
            line = self._line
        if line is not None:
            return line.add_odometry(sample)
        refusal = self._track.add(sample)
        self._track.trim(stamp - REACH_NS)
        return refusal

    def add_detections(
        self, found: Detections, joints: JointSample | CameraFrame | None = None
    ) -> Update | Refusal:
        """Correct the state by the landmarks of one image, see `points`."""
        self.use_camera(found.intrinsics)
        return self.add_points(self.points(found, joints))

    def add_points(self, seen: ImagePoints) -> Update | Refusal:
        """Correct the state by the landmarks of one image."""
        line, ends = self._line, self._track.stamps_ns
        if line is None:
            return _NOT_STARTED
        if self._start_odds < 0.0:
            return _WRONG_START
        if ends is not None and seen.stamp_ns - ends[1] > REACH_NS:
            return Refusal('detections are ahead', f'{1e-9 * (seen.stamp_ns - ends[1]):.1f} s')
        update = line.add_image(replace(seen, lost=self._integrity.contradicted))
        self._update = update if isinstance(update, Update) else None
        # From an unknown pose nothing is expected, so that nothing is missed.
        unknown = is_unknown(line.filter.predicted.covariance[:3, :3])
        self._integrity.add(seen.stamp_ns, self._update, 0 if unknown else len(seen.missed))
        self._elsewhere &= self._integrity.log_ratio < _TRUSTED
        if self._update is not None:
            self.used_image = True
            self._weigh_start(line, seen, self._update)
        self._unlikely = self.calibration.contradictions(self._may_be)
        sure = self._integrity.log_ratio >= _TRUSTED and self._anywhere is None
        if sure and self.status_at()[0] is Status.OK:
            self._trusted = line.filter.state
        if self._update is not None and self._update.stepped:
            if abs(seen.stamp_ns - self._turned_ns) > _AGAIN_NS:
                _LOG.warning('camera or base was turned, and the wheels did not measure it')
            self._turned_ns = seen.stamp_ns
        return update

    def _test_start(self) -> None:
        """Compare the pose with an unknown one from now on."""
        assert self._line is not None, 'it was placed'
        self._anywhere, self._given = copy(self._line.filter), self._line.filter.state
        self._anywhere.forget_pose()

    def _weigh_start(self, line: Timeline, seen: ImagePoints, update: Update) -> None:
        """Compare the evidence of an image with that for an unknown start."""
        anywhere = self._anywhere
        if anywhere is None or self._given is None:
            return
        move_to(seen.stamp_ns, anywhere, self._track)
        self._start_odds += update.log_evidence - anywhere.observe(seen).log_evidence
        if self._start_odds < 0.0:
            _LOG.warning('images contradict the given start: the place is searched in images')
            # Estimates from a wrong pose are wrong.
            line.filter.state = self._given
            self._begin(line.filter)
        elif not is_prior_uncertain(anywhere.estimate.covariance):
            self._anywhere = None

    def points(
        self, found: Detections, joints: JointSample | CameraFrame | None = None
    ) -> ImagePoints:
        """
        Return the measurements of an image, of landmarks that are in the map.

        Parameters
        ----------
        found : Detections
            Detections, with image points or bearings. Without points or joints the bearings are
            used, with the mount of `robot.yaml`, or with the calibrated one if there are points.
        joints : JointSample or CameraFrame, optional
            Measured pan and tilt at the stamp.
        """
        found = found.chosen(self._map.has(found.ids))
        missed = self._map.indices(found.missed[self._map.has(found.missed)])
        columns = self._map.indices(found.ids)
        if (len(found.points) and joints is not None) or not len(found):
            at = joints or JointSample(found.stamp_ns, 0.0)
            return ImagePoints(
                found.stamp_ns, columns, found.points, found.point_covariance,
                np.full(len(columns), at.pan_rad), at.tilt_rad, at.pan_rate_rad_s,
                at.pan_sigma_rad, at.pan_track, missed=missed, near=found.near,
                sizes=found.sizes if len(found.sizes) else None, by_lens=found.by_lens,
                below=found.below,
            )  # fmt: skip
        mount = self.calibration.mount if len(found.points) else self._prior.mount
        looked: float | None = None if len(found.points) else found.pan_rad
        if joints is not None:
            looked = float(mount.azimuth_base_rad(joints.pan_rad))
        points = ImagePoints.of_bearings(
            found.stamp_ns, columns, found.bearing_rad, found.variance_rad2, mount, looked,
            found.pan_sigma_rad if joints is None else joints.pan_sigma_rad,
        )  # fmt: skip
        return replace(points, missed=missed)

    def estimate(self, stamp_ns: int | None = None) -> PoseEstimate | None:
        """
        Pose of the base at a time, by default the newest; None before one is known.

        The covariance of a lost pose is inflated.
        """
        if self._line is None:
            return None
        return self._integrity.inflated_if_lost(self._line.estimate(stamp_ns), bool(self._wrong))

    def expectation(self, stamp_ns: int) -> Expectation | None:
        """Expected pose in an image of a time; None before a pose is known."""
        if self._line is None:
            return None
        expected = self._line.filter_at(stamp_ns).expectation
        known = replace(expected.calibration, intrinsics=self._prior.intrinsics)
        return replace(expected, calibration=known)

    def level(self, estimate: PoseEstimate) -> ProtectionLevel:
        """Bound of the error of an estimate at 99 %."""
        return protection_level(estimate, self._update)

    @property
    def calibration(self) -> Calibration:
        """The current estimate of the calibration."""
        return self._prior if self._line is None else self._line.filter.calibration

    @property
    def map_contradictions(self) -> list[str]:
        """What shows that the map is no longer right, or was not; one line each."""
        if self._line is None or self.status_at()[0] is Status.LOST:
            return []
        off = float(self._line.filter.state.mean[SCALE])
        sigma = hypot(self._odometry.bias_sigmas[0], self._map.scale_sigma)
        found = []
        if abs(off) > _SCALE_SIGMAS * sigma:
            side = 'shorter' if off > 0.0 else 'longer'
            found.append(
                f'ways by odom are {100.0 * abs(off / (1.0 + off)):.0f} % {side} than in the map '
                f'({abs(off) / sigma:.1f} sigma): check wheel sizes, or learn again without slip'
            )
        moved = [
            f'by {100.0 * hypot(*by):.0f} cm near x {x:.1f} y {y:.1f}'
            for (x, y, _), by in self._line.filter.moved_objects
            if hypot(*by) > _MOVED_M
        ]
        if moved:
            more = f' and {len(moved) - 3} more' if len(moved) > 3 else ''
            found.append(
                f'moved since learning: {", ".join(moved[:3])}{more}: learn the map again'
            )
        return found

    @property
    def late(self) -> JointDelay:
        """Delay of the joint states' stamps."""
        return JointDelay(*self.calibration['joint_delay'])

    @property
    def odometry_noise(self) -> OdometryNoiseConfig:
        """Noise of odometry as learned so far."""
        if self._line is None:
            return self._odometry
        way, turns, slip, *_ = np.sqrt(self._line.filter.state.scales.factors).tolist()
        return self._odometry.scaled(way, turns, slip)

    @property
    def detection_sigma_factor(self) -> float:
        """Factor on the sigmas of detections as learned so far."""
        return (
            1.0
            if self._line is None
            else float(np.sqrt(self._line.filter.state.scales.factors[-1]))
        )

    def status_at(self, stamp_ns: int | None = None) -> tuple[Status, str]:
        """State of the pose at a time, by default the newest, and the reason if it is not OK."""
        line, ends = self._line, self._track.stamps_ns
        if line is None:
            return Status.LOST, _NO_POSE if self._map.landmarks else _NO_LANDMARKS
        at_ns = line.newest_ns if stamp_ns is None else max(stamp_ns, line.newest_ns)
        status, reason = self._integrity.status(line.estimate(at_ns))
        if self._wrong:
            status, reason = Status.LOST, self._wrong
        name, sigmas = line.filter.contradiction
        if status is Status.OK and sigmas > _CONTRADICTION:
            status = Status.DEGRADED
            reason = f'images contradict {name} of robot.yaml by {sigmas:.0f} sigma: calibrate'
        silent_s = 1e-9 * ((stamp_ns or 0) - (ends[1] if ends else 0))
        if stamp_ns is None or silent_s <= _SILENT_S:
            return status, reason
        silence = f'no odometry for {silent_s:.1f} s' if ends else 'no odometry'
        if status is Status.OK:
            return Status.DEGRADED, silence
        return status, f'{silence}: {reason}'

    @property
    def _wrong(self) -> str:
        """Why the pose is wrong, however well it fits the images; empty if nothing says so."""
        if self._elsewhere:
            return _OTHER_MAP
        if self._start_odds < 0.0:
            return str(_WRONG_START)
        names = ', '.join(self._unlikely)
        return names and f'{names} would be far from robot.yaml: the robot is probably elsewhere'

    @property
    def _prior_late(self) -> JointDelay:
        """Prior of the delay at the start, which is wide unless the delay is known."""
        late = JointDelay(*self._prior['joint_delay'])
        return JointDelay(
            late.delay_s, late.sigma_s if late.is_known else max(late.sigma_s, DELAY_BOUND_S)
        )

    def _place(self, start: PoseEstimate, pan_rate_rad_s: float | None = None) -> None:
        """Set the pose, with the estimates of the robot from while the pose was right."""
        lost = self.status_at()[0] is Status.LOST
        wrong = self._integrity.contradicted or self._wrong
        if self._line is None or (lost and self._trusted is None):
            # All images of a pan motion agree on a heading that late joint states rotated.
            prior = self._prior_late.sigma_s**2 - self._prior['joint_delay'][1] ** 2
            widened = self._prior.widened({'joint_delay': sqrt(max(0.0, prior))})
            joint = self._new_filter(widened, start)
        else:
            joint = self._line.filter
            if wrong and self._trusted is not None:
                # Estimates from a wrong pose are wrong. If the start was right, the pose was wrong
                # for another reason: the camera may have been turned.
                joint.state = self._trusted
                if self._start_odds >= 0.0 and not self._elsewhere:
                    joint = joint.stepped()
        self._begin(joint.placed(start, pan_rate_rad_s))
        self._integrity, self._unlikely, self._elsewhere = Integrity(), (), False
        self._anywhere, self._start_odds = None, _GIVEN_RIGHT

    def _new_filter(self, prior: Calibration, start: PoseEstimate) -> JointFilter:
        return JointFilter(self._map, prior, start, self._config, self._odometry)

    def _change(self, changed: Callable[[JointFilter], JointFilter]) -> None:
        """Change the filter, and the trusted state with it."""
        if self._line is None:
            return
        joint = self._line.filter
        if self._trusted is not None:
            trusted = copy(joint)
            trusted.state = self._trusted
            self._trusted = changed(trusted).state
        self._begin(changed(joint))
        if self._anywhere is not None:
            self._test_start()

    def _begin(self, joint: JointFilter) -> None:
        self._line, self._update = Timeline(joint, self._track, self._config.history_s), None

    def _set_back(self, sample: OdometrySample) -> None:
        """Continue from the newest pose by another clock (a bag that starts over)."""
        self._track = OdometryTrack(self._odometry)
        self._track.add(sample)
        if self._line is not None:
            joint = self._line.filter_at(self._line.newest_ns)
            joint.move(joint.state.stamp_ns, _BLIND_SECOND)
            self._begin(_restamped(joint, sample.stamp_ns))
            self._integrity = Integrity()


def _restamped(joint: JointFilter, stamp_ns: int) -> JointFilter:
    """Return a filter with another time."""
    joint.state = replace(joint.state, stamp_ns=stamp_ns)
    return joint
