"""
Localization, stage by stage.

image and prior -> triplet, detection, triangulation; bearings and odometry -> fusion.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.estimator import EstimatorConfig, ImagePoints, ProtectionLevel
from landmark_nav.localization.fusion import FusionConfig, FusionUpdate, PoseFilter
from landmark_nav.localization.fusion.health import HealthConfig
from landmark_nav.localization.fusion.start import Found
from landmark_nav.localization.joint_delay import in_time, JointDelay, PanMotion
from landmark_nav.localization.observation import Observation, ObservationConfig, Observer
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.relocalization import (
    RelocalizationConfig,
    Relocalizer,
    UncertainPose,
    Unseen,
)
from landmark_nav.localization.triplet import CameraState
from landmark_nav.localization.triplet.active_camera import ActiveCamera
from landmark_nav.parameters import Config, parameter
from landmark_nav.types import (
    CameraFrame,
    Detections,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
    Triplet,
)

__all__ = [
    'LocalizationConfig',
    'LocalizationUpdate',
    'Localizer',
]


@dataclass(frozen=True)
class LocalizationConfig(Config):
    """Parameters of all stages."""

    observation: ObservationConfig = field(default_factory=ObservationConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    odometry: OdometryNoiseConfig = field(default_factory=OdometryNoiseConfig)
    health: HealthConfig = field(default_factory=HealthConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)
    joint: EstimatorConfig = field(default_factory=EstimatorConfig)
    choice_period_s: float = parameter(
        0.5, 'time between two choices of the triplet, s', minimum=0.0
    )
    estimator: str = parameter(
        'auto',
        'what estimates the pose: the filter of bearings, or the joint estimator of pose, '
        'calibration and map errors; auto takes the second where robot.yaml gives sigmas',
        choices=('auto', 'filter', 'joint'),
    )


@dataclass(frozen=True, eq=False)
class LocalizationUpdate:
    """
    All results of one image.

    Parameters
    ----------
    triplet : Triplet or Refusal
        What the camera should be turned to, as last chosen.
    observation, fusion : Observation, FusionUpdate
        What was seen, and what the filter made of it.
    fused : PoseEstimate
        The filter's estimate at the image's stamp, after the update.
    status, reason : str
        Of the filter, after the update.
    with_landmarks : ndarray, shape (3, 2 n), optional
        Covariance of `fused` with the positions of all landmarks.
    search : PoseEstimate or Refusal, optional
        Result of searching for the place, if that was done.
    level : ProtectionLevel, optional
        What the error of `fused` stays within, with 99 %.
    points : ImagePoints, optional
        What the joint estimator was given.

    """

    stamp_ns: int
    triplet: Triplet | Refusal
    observation: Observation
    fusion: FusionUpdate
    fused: PoseEstimate
    status: str
    reason: str
    with_landmarks: FloatArray | None = None
    search: PoseEstimate | Refusal | None = None
    level: ProtectionLevel | None = None
    points: ImagePoints | None = None


class Localizer:
    """
    The nodes of the navigation phase in one: for bags, and for use without ROS.

    Without `initialize`, and while it is lost or no landmark is in sight, it searches for the
    place: it gathers images until they fit one place only.
    """

    def __init__(
        self, landmark_map: LandmarkMap, mount: PanTiltMount, config: LocalizationConfig
    ) -> None:
        self._map, self._mount, self._config = landmark_map, mount, config
        self._filter = PoseFilter(
            landmark_map, mount, config.fusion, config.odometry, config.health
        )
        self._camera = ActiveCamera(landmark_map, mount, config.observation.triplet)
        self._observer = Observer(landmark_map, mount, config.observation, config.odometry)
        self._camera_state = CameraState()
        self._chosen_ns: int | None = None
        self._triplet: Triplet | Refusal = Refusal('no image')
        self._odometry: OdometrySample | None = None
        self._relocalizer: Relocalizer | None = self._new_search()
        self._unseen = Unseen(config.relocalization.unseen_s)

    def _new_search(self) -> Relocalizer:
        config = self._config
        search = Relocalizer(
            self._map, self._mount, config.relocalization, config.odometry, config.observation
        )
        if self._odometry is not None:
            search.add_odometry(self._odometry)
        return search

    def initialize(self, start: PoseEstimate) -> None:
        """Start anew at a pose of the base."""
        self._start(start)

    def _start(self, start: PoseEstimate, found: Found | None = None) -> None:
        self._filter.initialize(start, found=found)
        self._relocalizer = None
        self._unseen.restart()

    def add_odometry(self, sample: OdometrySample) -> Refusal | None:
        """Move on; what is wrong with the sample, if anything (`Distrusted` if it is used)."""
        self._odometry = sample
        self._observer.add_odometry(sample)
        if self._relocalizer is not None:
            self._relocalizer.add_odometry(sample)
        return self._filter.add_odometry(sample)

    @property
    def odometry_noise(self) -> OdometryNoiseConfig:
        """How far odometry is to be trusted, as far as it was learned."""
        return self._filter.odometry_noise

    @property
    def detection_sigma_factor(self) -> float:
        """Factor on what detections claim as their sigmas, as far as it was learned."""
        return self._filter.detection_sigma_factor

    @property
    def late(self) -> JointDelay:
        """Of the stamps of the joints, as far as it was measured."""
        return self._filter.late

    @property
    def status(self) -> tuple[str, str]:
        """``tracking``, ``coasting`` or ``lost``, and the reason for the last two."""
        return self._filter.status

    def estimate(self, stamp_ns: int | None = None) -> PoseEstimate | None:
        """Pose of the base at a time, the newest by default; None before one is known."""
        return self._filter.estimate(stamp_ns)

    def add_frame(self, frame: CameraFrame) -> LocalizationUpdate | PoseEstimate | Refusal:
        """
        Look at an image and correct the pose, or search for the place until one is known.

        Returns
        -------
        LocalizationUpdate or PoseEstimate or Refusal
            An update if a pose was known before; otherwise the pose that was found, or why none
            was.

        """
        prior = self._filter.estimate(frame.stamp_ns)
        if prior is None:
            return self._search(frame)
        self._choose(frame, prior)
        seen = self._observer.look(frame, prior, self._triplet, self._filter.late)
        self._camera.saw(seen.detections)
        update = self._fused(frame.stamp_ns, self._triplet, seen)
        self._unseen.note(frame.stamp_ns, len(seen.detections))
        uncertain = update.status == 'lost' or self._unseen.lasts
        search = self._config.relocalization.when_lost and self._map.landmarks
        if not (uncertain and search) or seen.unusable:
            self._relocalizer = None
            return update
        self._relocalizer = self._relocalizer or self._new_search()
        outcome = self._search(frame)
        if self._unseen.lasts and isinstance(outcome, UncertainPose):
            # No landmark is expected here, so only another place can contradict the pose.
            self._filter.contradict(outcome.place, str(outcome))
        status, reason = self._filter.status_at(frame.stamp_ns)
        fused = self._filter.estimate(frame.stamp_ns) or update.fused
        return replace(update, fused=fused, status=status, reason=reason, search=outcome)

    def _choose(self, frame: CameraFrame, prior: PoseEstimate) -> None:
        """Choose the triplet anew if it is time to."""
        since_s = np.inf if self._chosen_ns is None else 1e-9 * (frame.stamp_ns - self._chosen_ns)
        if self._camera.done_here or not 0.0 <= since_s < self._config.choice_period_s:
            camera_state = replace(
                self._camera_state, pan_rad=frame.pan_rad, tilt_rad=frame.tilt_rad
            )
            self._triplet = self._camera.choose(prior, frame.camera, camera_state).chosen
            self._chosen_ns = frame.stamp_ns

    def _search(self, frame: CameraFrame) -> PoseEstimate | Refusal:
        """Search for the place; the images from which it is found are not fused again."""
        assert self._relocalizer is not None, 'no pose is known'
        late = self._filter.late
        frame, _ = in_time(frame, late)
        outcome = self._relocalizer.add_frame(frame, self._observer.camera_tilt)
        if isinstance(outcome, Refusal):
            return outcome
        self._observer.turn(*self._relocalizer.tilt_roll_rad)
        pan_motion = PanMotion.of(frame, self._mount)
        # The filter itself inflates the heading of a camera that turned.
        found = Found(
            self._relocalizer.landmark_ids, pan_motion.rate_rad_s, pan_motion.track, late.delay_s
        )
        self._start(self._relocalizer.in_time, found)
        return self._filter.estimate(frame.stamp_ns) or outcome

    def add_detections(self, found: Detections) -> LocalizationUpdate | Refusal:
        """Correct the pose by bearings that somebody else measured; else like `add_frame`."""
        prior = self._filter.estimate(found.stamp_ns)
        if prior is None:
            return Refusal('not initialized', 'bearings alone give no first pose')
        no_view = Refusal('no image', 'the bearings were found elsewhere')
        return self._fused(found.stamp_ns, no_view, self._observer.take(found, prior))

    def _fused(
        self, stamp_ns: int, triplet: Triplet | Refusal, seen: Observation
    ) -> LocalizationUpdate:
        """Correct the filter by what was seen."""
        if seen.unusable and isinstance(seen.fix, Refusal):
            update = self._filter.no_pose(stamp_ns, seen.fix)
        else:
            update = self._filter.add_detections(seen.detections)
        if self._config.fusion.mode == 'poses':
            if isinstance(seen.fix, PoseEstimate):
                update = self._filter.add_pose(seen.fix)
            else:
                update = self._filter.no_pose(stamp_ns, seen.fix)
        fused = self._filter.estimate(stamp_ns)
        assert fused is not None, 'it was initialized'
        status, reason = self._filter.status_at(stamp_ns)
        with_landmarks = self._filter.with_landmarks(stamp_ns)
        return LocalizationUpdate(
            stamp_ns, triplet, seen, update, fused, str(status), reason, with_landmarks
        )
