"""
Localization by the joint estimator: it looks where its own state says, and asks no other model.

The calibrated mount of the state puts the camera; the covariance of pose and mount together sets
the search windows. So what is not known is searched for, and what was learned narrows the search.
"""

from __future__ import annotations

from dataclasses import replace
import logging

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.calibration import Calibration
from landmark_nav.localization.detection.blurred import detect_blurred
from landmark_nav.localization.detection.correlation import DetectionResult
from landmark_nav.localization.detection.expectation import NOT_LOOKED_FOR
from landmark_nav.localization.detection.informative import most_informative
from landmark_nav.localization.estimator import (
    ImagePoints,
    Integrity,
    JointFilter,
    protection_level,
    ProtectionLevel,
    Status,
    Update,
)
from landmark_nav.localization.estimator.timeline import Timeline
from landmark_nav.localization.frozen_image import FrozenImage
from landmark_nav.localization.fusion import FusionUpdate
from landmark_nav.localization.joint_delay import JointDelay
from landmark_nav.localization.observation import Observation
from landmark_nav.localization.odometry.noise import Motion, OdometryNoiseConfig
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.localization.pipeline import LocalizationConfig, LocalizationUpdate
from landmark_nav.localization.prior_uncertainty import is_prior_uncertain
from landmark_nav.localization.relocalization import Relocalizer
from landmark_nav.localization.relocalization.within_prior import localize_within_prior
from landmark_nav.localization.triangulation.bearing_buffer import BearingBuffer
from landmark_nav.localization.triangulation.model import axis_from_base
from landmark_nav.localization.triplet import visible_landmarks
from landmark_nav.types import (
    CameraFrame,
    Detections,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)

__all__ = ['JointLocalizer']

_LOG = logging.getLogger(__name__)

# Shares of the landmarks looked for that count as most of them, and as hardly any.
_MOST, _HARDLY_ANY = 0.75, 0.25
# Largest error of the rows that the search allows for, pixels.
_MOST_RISE_PX = 50.0
# The novelty of a landmark is halved when it is looked for, and recovers by a fifth an image.
_NEW, _STILL_KNOWN = 0.5, 0.8
# Stamps that are older than the window by so much, of odometry and images, are of another clock;
# the motion meanwhile is that of so many blind seconds.
_CLOCK_STEP_NS, _UNKNOWN_S = 10**9, 0.1
# Steps in which the lens is put right for drawing templates, over the focal length.
_STEP = 4e-4
_NO_TRIPLET = Refusal('no triplet', 'the joint estimator takes what is most informative')
# States as the rest of the package calls them.
_STATUS = {Status.OK: 'tracking', Status.DEGRADED: 'coasting', Status.LOST: 'lost'}
# A detection of less weight than this is an outlier.
_OUTLIER = 0.1


class JointLocalizer:
    """
    Same calls as `Localizer`, another estimator.

    Parameters
    ----------
    landmark_map : LandmarkMap
        What to look for.
    calibration : Calibration
        Prior of mount, lens and clocks.
    config : LocalizationConfig
        Of detection, odometry, relocalization and the estimator.

    """

    def __init__(
        self, landmark_map: LandmarkMap, calibration: Calibration, config: LocalizationConfig
    ) -> None:
        self._map, self._prior, self._config = landmark_map, calibration, config
        self._track = OdometryTrack(config.odometry)
        self._line: Timeline | None = None
        self._integrity, self._update = Integrity(), None  # type: Integrity, Update | None
        self._frozen, self._sample = FrozenImage(), OdometrySample(0, np.zeros(3))
        self._blur, self._found_most = np.zeros(2), False
        self._novelty = np.ones(len(landmark_map.landmarks))
        self._bearing_buffer = BearingBuffer(
            landmark_map, calibration.mount, 0.0, config.odometry, config.observation.triangulation
        )
        self._relocalizer: Relocalizer | None = self._search()

    def initialize(self, start: PoseEstimate) -> None:
        """Start anew at a pose of the base."""
        self._place(start, by_camera=False)

    def add_odometry(self, sample: OdometrySample) -> Refusal | None:
        """Move on; what is wrong with the sample, if anything."""
        self._frozen.add_odometry(sample)
        self._sample = sample
        if self._relocalizer is not None:
            self._relocalizer.add_odometry(sample)
        return self._track.add(sample) if self._line is None else self._line.add_odometry(sample)

    def estimate(self, stamp_ns: int | None = None) -> PoseEstimate | None:
        """Pose of the base at a time, the newest by default; None before one is known."""
        return None if self._line is None else self._line.estimate(stamp_ns)

    @property
    def calibration(self) -> Calibration:
        """The calibration as far as it is known by now."""
        return self._prior if self._line is None else self._line.filter.calibration

    @property
    def level(self) -> ProtectionLevel | None:
        """What the error of the newest estimate stays within, with 99 %."""
        estimate = self.estimate()
        return None if estimate is None else protection_level(estimate, self._update)

    @property
    def late(self) -> JointDelay:
        """Delay of the stamps of the joints."""
        return JointDelay(*self.calibration['joint_delay'])

    @property
    def odometry_noise(self) -> OdometryNoiseConfig:
        """How far odometry is to be trusted, as far as it was learned."""
        if self._line is None:
            return self._config.odometry
        way, turns, slip, *_ = np.sqrt(self._line.filter.noise_factors).tolist()
        return self._config.odometry.scaled(way, turns, slip)

    @property
    def detection_sigma_factor(self) -> float:
        """Factor on what detections claim as their sigmas, as far as it was learned."""
        return 1.0 if self._line is None else float(np.sqrt(self._line.filter.noise_factors[-1]))

    @property
    def status(self) -> tuple[str, str]:
        """``tracking``, ``coasting`` or ``lost``, and the reason for the last two."""
        estimate = self.estimate()
        if estimate is None:
            return 'lost', 'no pose is known'
        status, reason = self._integrity.status(estimate)
        return _STATUS[status], reason

    def add_frame(self, frame: CameraFrame) -> LocalizationUpdate | PoseEstimate | Refusal:
        """Look at an image and correct the pose, or search for the place until one is known."""
        if self._line is None:
            return self._found(frame)
        if self._frozen.repeats(frame):
            return self._used(
                frame.stamp_ns,
                Observation(_nothing(frame.stamp_ns), {}, Refusal('image hangs'), unusable=True),
                None,
            )
        if (
            self._line.begin_ns - frame.stamp_ns
            > _CLOCK_STEP_NS
            > abs(self._sample.stamp_ns - frame.stamp_ns)
        ):
            self._set_back()
        joint = self._line.filter_at(frame.stamp_ns)
        if is_prior_uncertain(joint.camera.covariance):
            place = localize_within_prior(
                self._straight(frame, joint),
                joint.camera,
                self._map,
                joint.calibration.mount,
                self._config.observation,
            )
            if not isinstance(place, Refusal):
                self._place(place.estimate, by_camera=True)
                joint = self._line.filter_at(frame.stamp_ns)
        seen = self._look(frame, joint)
        found = seen.detections
        points = ImagePoints.of_pixels(
            frame.stamp_ns,
            self._map.indices(found.ids),
            found.uv_px,
            found.covariance_px2,
            frame.camera,
            frame.pan_rad,
            frame.tilt_rad,
            frame.pan_rate_rad_s,
            frame.pan_sigma_rad,
            frame.pan_track,
            self._map.indices(found.missed),
        )
        update = self._used(frame.stamp_ns, seen, points)
        if update.status != 'lost' or not self._config.relocalization.when_lost:
            self._relocalizer = None
            return update
        self._relocalizer = self._relocalizer or self._search()
        outcome = self._found(frame)
        status, reason = self.status
        fused = self.estimate(frame.stamp_ns) or update.fused
        return replace(update, fused=fused, status=status, reason=reason, search=outcome)

    def add_detections(self, found: Detections) -> LocalizationUpdate | Refusal:
        """Correct the pose by bearings that somebody else measured."""
        if self._line is None:
            return Refusal('not initialized', 'give a start pose')
        known = np.isin(found.ids, self._map.ids)
        refused = {int(k): Refusal('not in the map') for k in found.ids[~known]}
        found = found.chosen(known)
        points = ImagePoints.of_bearings(
            found.stamp_ns,
            self._map.indices(found.ids),
            found.bearing_rad,
            found.variance_rad2,
            self._prior.mount,
            found.pan_rad,
            found.pan_sigma_rad,
        )
        seen = Observation(found, refused, self._fix(found, self._line.estimate(found.stamp_ns)))
        return self._used(found.stamp_ns, seen, points)

    def _place(self, start: PoseEstimate, by_camera: bool, was_lost: bool = False) -> None:
        """Be at a pose, with all that was learned of the robot."""
        if self._line is None:
            config = self._config
            joint = JointFilter(self._map, self._prior, start, config.joint, config.odometry)
        else:
            joint = self._line.filter
            if was_lost:
                # It was lost for a reason: the camera may have been turned.
                joint = joint.stepped()
        self._line = Timeline(
            joint.placed(start, by_camera), self._track, self._config.fusion.history_s
        )
        self._integrity, self._update, self._relocalizer = Integrity(), None, None

    def _set_back(self) -> None:
        """Go on from the newest pose at the last odometry: the clock of all was set back."""
        assert self._line is not None, 'a pose is known'
        joint, stamp = self._line.filter, self._sample.stamp_ns
        _LOG.warning('clock was set back: localization goes on from the last pose')
        # Nobody knows for how long; the robot may have moved as far as in a blind second.
        joint.move(joint.snapshot.stamp_ns, Motion(np.zeros(3), 0.0, blind_seconds=_UNKNOWN_S))
        joint.restore(replace(joint.snapshot, stamp_ns=stamp))
        self._track = OdometryTrack(self._config.odometry)
        self._track.add(self._sample)
        self._line = Timeline(joint, self._track, self._config.fusion.history_s)
        self._integrity, self._relocalizer = Integrity(), None

    def _search(self) -> Relocalizer:
        config = self._config
        return Relocalizer(
            self._map, self.calibration.mount, config.relocalization, config.odometry,
            config.observation,
        )  # fmt: skip

    def _found(self, frame: CameraFrame) -> PoseEstimate | Refusal:
        """Search for the place."""
        assert self._relocalizer is not None, 'it searches'
        outcome = self._relocalizer.add_frame(frame)
        if isinstance(outcome, PoseEstimate):
            self._place(self._relocalizer.in_time, by_camera=True, was_lost=True)
            return self.estimate(frame.stamp_ns) or outcome
        return outcome

    def _straight(self, frame: CameraFrame, joint: JointFilter) -> CameraFrame:
        """Return an image with camera and joints as the state has them."""
        calibration = joint.calibration
        none = np.empty(0, dtype=np.intp)
        blank = ImagePoints.of_pixels(
            frame.stamp_ns, none, np.empty((0, 2)), np.empty((0, 2, 2)), frame.camera, 0.0,
            pan_rate_rad_s=frame.pan_rate_rad_s, pan_track=frame.pan_track,
        )  # fmt: skip
        blank = replace(blank, pan_rad=np.array([frame.pan_rad]))
        pan = float(blank.pans(calibration['joint_delay'][0])[0][0])
        # In steps of a tenth of a pixel, as each camera needs a grid of rays of its own.
        focal, shift = (
            _STEP * round(calibration[name][0] / _STEP)
            for name in ('focal_scale', 'principal_point')
        )
        camera = frame.camera
        camera = replace(
            camera,
            fx=camera.fx * (1.0 + focal),
            fy=camera.fy * (1.0 + focal),
            cx=camera.cx + shift * camera.fx,
        )
        return replace(
            frame,
            camera=camera,
            pan_rad=pan * (1.0 + calibration['pan_scale'][0]),
            tilt_rad=frame.tilt_rad + calibration['camera_tilt'][0],
        )

    def _look(self, frame: CameraFrame, joint: JointFilter) -> Observation:
        """
        Look for some of the visible landmarks: a few as long as most are found.

        If hardly any is found, all are looked for where they should be if camera or base was
        turned.
        """
        config = self._config.observation
        visible = self._visible(frame, joint)
        enough, most = config.detection.target_count, config.detection.max_count
        tries = [(joint, enough)] if self._found_most and enough < len(visible) else []
        for state, count in [*tries, (joint, most), (joint.stepped(), most)]:
            result, expected = self._searched(frame, state, visible, count)
            found = len(result.detections)
            self._found_most = found >= _MOST * len(expected)
            if self._found_most or (count == most and found > _HARDLY_ANY * len(expected)):
                break
        self._novelty = 1.0 - _STILL_KNOWN * (1.0 - self._novelty)
        self._novelty[expected] *= _NEW
        missed = [k for k, why in result.refused.items() if why.reason not in NOT_LOOKED_FOR]
        detections = replace(
            result.detections,
            missed=np.array(sorted(missed), dtype=np.int64),
            pan_rate_rad_s=frame.pan_rate_rad_s,
            pan_sigma_rad=frame.pan_sigma_rad,
            pan_rad=float(joint.calibration.mount.azimuth_base_rad(frame.pan_rad)),
        )
        return Observation(detections, dict(result.refused), self._fix(detections, joint.estimate))

    def _visible(self, frame: CameraFrame, joint: JointFilter) -> IndexArray:
        straight = self._straight(frame, joint)
        return visible_landmarks(
            joint.camera, self._map, straight.camera, joint.calibration.mount, straight.pan_rad,
            straight.tilt_rad, self._config.observation.triplet,
        )  # fmt: skip

    def _searched(
        self, frame: CameraFrame, joint: JointFilter, visible: IndexArray, count: int
    ) -> tuple[DetectionResult, IndexArray]:
        """Look for `count` of the visible landmarks, as far around as the state says."""
        config = self._config.observation
        mount, prior = joint.calibration.mount, joint.camera
        # An error of the pan shifts the image as one of the heading does.
        pan = joint.pan_sigma_rad(frame.pan_rate_rad_s)
        shifted = np.diag([0.0, 0.0, pan**2 + frame.pan_sigma_rad**2])
        rise_px = np.hypot(
            config.detection.vertical_sigma_px, frame.camera.fy * joint.tilt_sigma_rad
        )
        detection = replace(config.detection, vertical_sigma_px=min(_MOST_RISE_PX, float(rise_px)))
        expected = most_informative(
            axis_from_base(prior, mount), self._map, visible, config.triplet.bearing_sigma_rad,
            count, (), self._novelty,
        )  # fmt: skip
        result, self._blur = detect_blurred(
            self._straight(frame, joint),
            replace(prior, covariance=prior.covariance + shifted),
            self._map,
            mount,
            detection,
            expected,
            self._blur,
        )
        return result, expected

    def _fix(self, found: Detections, prior: PoseEstimate) -> PoseEstimate | Refusal:
        self._bearing_buffer.add(found)
        return self._bearing_buffer.fix(prior)

    def _used(
        self, stamp_ns: int, seen: Observation, points: ImagePoints | None
    ) -> LocalizationUpdate:
        """Correct the filter by what was seen."""
        assert self._line is not None, 'a pose is known'
        taken: Update | Refusal | None = None
        if points is not None:
            taken = self._line.add_image(points)
        update = taken if isinstance(taken, Update) else None
        self._update = update
        if points is not None:
            self._integrity.add(stamp_ns, update, len(points.missed))
        if update is not None and update.stepped:
            _LOG.warning('camera or base was turned, and the wheels did not measure it')
        joint = self._line.filter_at(stamp_ns)
        fused = joint.estimate
        status, reason = self._integrity.status(fused)
        return LocalizationUpdate(
            stamp_ns,
            _NO_TRIPLET,
            seen,
            self._fusion_update(stamp_ns, update, taken),
            fused,
            _STATUS[status],
            reason,
            joint.with_landmarks(),
            level=protection_level(fused, update),
        )

    def _fusion_update(
        self, stamp_ns: int, update: Update | None, taken: Update | Refusal | None
    ) -> FusionUpdate:
        if update is None:
            refusal = taken if isinstance(taken, Refusal) else Refusal('nothing seen')
            return FusionUpdate(stamp_ns, refusal=refusal)
        ids, good = self._map.ids[update.columns], update.weight > _OUTLIER
        squares = np.einsum(
            'mi,mi->m',
            update.residual,
            np.linalg.solve(update.covariance, update.residual[..., None])[..., 0],
        )
        return FusionUpdate(
            stamp_ns,
            ids[good],
            update.residual[good, 0],
            float(squares[good].sum()),
            int(good.sum()) * update.residual.shape[1],
            {int(k): Refusal('outlier') for k in ids[~good]},
        )


def _nothing(stamp_ns: int) -> Detections:
    none = np.empty(0)
    return Detections(stamp_ns, none.astype(np.int64), none, none, none, none.reshape(0, 2))
