"""
The whole localization in one class, for bags and for use without ROS.

image and expectation -> observer -> detections; detections and odometry -> fusion -> pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from landmark_nav.calibration import Calibration
from landmark_nav.localization.estimator.config import EstimatorConfig
from landmark_nav.localization.estimator.factors import ImagePoints
from landmark_nav.localization.estimator.integrity import ProtectionLevel
from landmark_nav.localization.estimator.state import Update
from landmark_nav.localization.fusion import Fusion
from landmark_nav.localization.image_stages import ImageStagesConfig
from landmark_nav.localization.observer import Observation, Observer, straight
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.relocalization.search import RelocalizationConfig
from landmark_nav.localization.relocalization.stream import Relocalizer, Unseen
from landmark_nav.parameters import OF_ROBOT
from landmark_nav.types import (
    CameraFrame,
    Detections,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)


@dataclass(frozen=True)
class LocalizationConfig(ImageStagesConfig):
    """Parameters of all stages."""

    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)
    odometry: OdometryNoiseConfig = field(default_factory=OdometryNoiseConfig, metadata=OF_ROBOT)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)


@dataclass(frozen=True, eq=False)
class LocalizationUpdate:
    """
    All results of one image.

    Parameters
    ----------
    observation : Observation
        Landmarks found and refused.
    used : int
        Number of landmarks that corrected the pose.
    fused : PoseEstimate
        Estimate at the image's stamp, after the update.
    status, reason : str
        ``OK``, ``degraded`` or ``lost`` after the update, and the reason for the last two.
    search : PoseEstimate or Refusal, optional
        Result of the relocalization, if it was run.
    level : ProtectionLevel, optional
        Bound of the error of `fused` at 99 %.
    points : ImagePoints, optional
        Input of the estimator.
    taken : Update or Refusal, optional
        Update of the estimator, or why the image was not used.
    """

    stamp_ns: int
    observation: Observation
    used: int
    fused: PoseEstimate
    status: str
    reason: str
    search: PoseEstimate | Refusal | None = None
    level: ProtectionLevel | None = None
    points: ImagePoints | None = None
    taken: Update | Refusal | None = None


class Localizer:
    """
    Detection, relocalization and the estimator: what the nodes of the navigation phase do.

    Without `initialize`, and while it is lost or no landmark is in view, it relocalizes: it
    collects images until only one place explains them.

    Parameters
    ----------
    calibration : Calibration
        Prior of mount, lens and clocks.
    config : LocalizationConfig
        Parameters of detection, odometry, relocalization and the estimator.
    """

    def __init__(
        self, landmark_map: LandmarkMap, calibration: Calibration, config: LocalizationConfig
    ) -> None:
        self._map, self._config = landmark_map, config
        self.fusion = Fusion(landmark_map, calibration, config.estimator, config.odometry)
        self._observer = Observer(landmark_map, calibration, config, config.estimator)
        self._unseen = Unseen(config.relocalization.unseen_s)
        self._sample: OdometrySample | None = None
        self._relocalizer: Relocalizer | None = self._new_search()

    def initialize(self, start: PoseEstimate) -> None:
        """Restart at a pose of the base."""
        self.fusion.initialize(start)
        self._relocalizer = None
        self._unseen.restart()

    def add_odometry(self, sample: OdometrySample) -> Refusal | None:
        """Predict by a sample of odometry; return what is wrong with it, if anything."""
        self._sample = sample
        self._observer.add_odometry(sample)
        if self._relocalizer is not None:
            self._relocalizer.add_odometry(sample)
        return self.fusion.add_odometry(sample)

    def add_frame(self, frame: CameraFrame) -> LocalizationUpdate | PoseEstimate | Refusal:
        """
        Correct the pose by an image, or search for the place while there is no pose.

        Returns
        -------
        LocalizationUpdate or PoseEstimate or Refusal
            An update if there was a pose before; otherwise the pose found, or why none was found.
        """
        self.fusion.use_camera(frame.camera.intrinsics)
        expected = self.fusion.expectation(frame.stamp_ns)
        if expected is None:
            return self._search(frame)
        seen = self._observer.look(frame, expected)
        update = self._updated(seen, self.fusion.points(seen.detections, frame))
        self._unseen.note(frame.stamp_ns, len(seen.detections))
        searches = update.status == 'lost' or self._unseen.lasts
        if not searches or seen.unusable or not self._config.relocalization.when_lost:
            self._relocalizer = None
            return update
        self._relocalizer = self._relocalizer or self._new_search()
        outcome = self._search(frame)
        status, reason = self.status(frame.stamp_ns)
        fused = self.fusion.estimate(frame.stamp_ns) or update.fused
        return replace(update, fused=fused, status=status, reason=reason, search=outcome)

    def add_detections(self, found: Detections) -> LocalizationUpdate | Refusal:
        """Correct the pose by bearings of another sensor."""
        prior = self.fusion.estimate(found.stamp_ns)
        if prior is None:
            return Refusal('no images: bearings alone show no place')
        known = self._map.has(found.ids)
        refused = {int(k): Refusal('not in the map') for k in found.ids[~known]}
        found = found.chosen(known)
        seen = Observation(found, refused, lambda: self._observer.fix(found, prior))
        return self._updated(seen, self.fusion.points(found))

    def status(self, stamp_ns: int | None = None) -> tuple[str, str]:
        """``OK``, ``degraded`` or ``lost``, and the reason for the last two."""
        status, reason = self.fusion.status_at(stamp_ns)
        return status.value, reason

    def _new_search(self) -> Relocalizer:
        config, mount = self._config, self.fusion.calibration.mount
        search = Relocalizer(self._map, mount, config.relocalization, config.odometry, config)
        if self._sample is not None:
            search.add_odometry(self._sample)
        return search

    def _search(self, frame: CameraFrame) -> PoseEstimate | Refusal:
        """Relocalize; images that contribute to the result are not fused again."""
        assert self._relocalizer is not None, 'it searches'
        outcome = self._relocalizer.add_frame(straight(frame, self.fusion.calibration))
        if isinstance(outcome, Refusal):
            return outcome
        if not self.fusion.reaches(frame.stamp_ns):
            return Refusal('the image is far off the odometry', 'are their clocks the same?')
        self.fusion.place(self._relocalizer.in_time, frame)
        self._relocalizer = None
        self._unseen.restart()
        return self.fusion.estimate(frame.stamp_ns) or outcome

    def _updated(self, seen: Observation, points: ImagePoints) -> LocalizationUpdate:
        """Correct the state by the points of an image."""
        stamp, taken = points.stamp_ns, self.fusion.add_points(points)
        fused = self.fusion.estimate(stamp)
        assert fused is not None, 'a pose is known'
        status, reason = self.status(stamp)
        return LocalizationUpdate(
            stamp,
            seen,
            len(taken.used) if isinstance(taken, Update) else 0,
            fused,
            status,
            reason,
            level=self.fusion.level(fused),
            points=points,
            taken=taken,
        )
