"""The nodes with the joint estimator in one: for bags, and for use without ROS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.localization.estimator import ImagePoints, ProtectionLevel, Status, Update
from landmark_nav.localization.fusion import FusionUpdate
from landmark_nav.localization.joint_delay import JointDelay
from landmark_nav.localization.joint_fusion import JointFusion
from landmark_nav.localization.joint_observer import JointObserver, straight
from landmark_nav.localization.observation import Observation
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.pipeline import LocalizationConfig, LocalizationUpdate
from landmark_nav.localization.relocalization import Relocalizer, Unseen
from landmark_nav.types import (
    CameraFrame,
    Detections,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)

__all__ = ['JointLocalizer']

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
        self._map, self._config = landmark_map, config
        self._fusion = JointFusion(
            landmark_map, calibration, config.joint, config.odometry, config.fusion.history_s
        )
        self._observer = JointObserver(
            landmark_map, calibration, config.observation, config.joint, config.odometry
        )
        self._unseen = Unseen(config.relocalization.unseen_s)
        self._sample: OdometrySample | None = None
        self._relocalizer: Relocalizer | None = self._new_search()

    def initialize(self, start: PoseEstimate) -> None:
        """Start anew at a pose of the base."""
        self._fusion.initialize(start)
        self._relocalizer = None
        self._unseen.restart()

    def add_odometry(self, sample: OdometrySample) -> Refusal | None:
        """Move on; what is wrong with the sample, if anything."""
        self._sample = sample
        self._observer.add_odometry(sample)
        if self._relocalizer is not None:
            self._relocalizer.add_odometry(sample)
        return self._fusion.add_odometry(sample)

    def estimate(self, stamp_ns: int | None = None) -> PoseEstimate | None:
        """Pose of the base at a time, the newest by default; None before one is known."""
        return self._fusion.estimate(stamp_ns)

    @property
    def calibration(self) -> Calibration:
        """The calibration as far as it is known by now."""
        return self._fusion.calibration

    @property
    def level(self) -> ProtectionLevel | None:
        """What the error of the newest estimate stays within, with 99 %."""
        estimate = self._fusion.estimate()
        return None if estimate is None else self._fusion.level(estimate)

    @property
    def late(self) -> JointDelay:
        """Delay of the stamps of the joints."""
        return self._fusion.late

    @property
    def odometry_noise(self) -> OdometryNoiseConfig:
        """How far odometry is to be trusted, as far as it was learned."""
        return self._fusion.odometry_noise

    @property
    def detection_sigma_factor(self) -> float:
        """Factor on what detections claim as their sigmas, as far as it was learned."""
        return self._fusion.detection_sigma_factor

    @property
    def status(self) -> tuple[str, str]:
        """``tracking``, ``coasting`` or ``lost``, and the reason for the last two."""
        status, reason = self._fusion.status_at()
        return _STATUS[status], reason

    def add_frame(self, frame: CameraFrame) -> LocalizationUpdate | PoseEstimate | Refusal:
        """Look at an image and correct the pose, or search for the place until one is known."""
        expected = self._fusion.expectation(frame.stamp_ns)
        if expected is None:
            return self._search(frame)
        seen = self._observer.look(frame, expected)
        update = self._updated(seen, self._fusion.points(seen.detections, frame))
        self._unseen.note(frame.stamp_ns, len(seen.detections))
        searches = update.status == 'lost' or self._unseen.lasts
        if not searches or seen.unusable or not self._config.relocalization.when_lost:
            self._relocalizer = None
            return update
        self._relocalizer = self._relocalizer or self._new_search()
        outcome = self._search(frame)
        status, reason = self.status
        fused = self.estimate(frame.stamp_ns) or update.fused
        return replace(update, fused=fused, status=status, reason=reason, search=outcome)

    def add_detections(self, found: Detections) -> LocalizationUpdate | Refusal:
        """Correct the pose by bearings that somebody else measured."""
        prior = self._fusion.estimate(found.stamp_ns)
        if prior is None:
            return Refusal('not initialized', 'give a start pose')
        known = np.isin(found.ids, self._map.ids)
        refused = {int(k): Refusal('not in the map') for k in found.ids[~known]}
        found = found.chosen(known)
        seen = Observation(found, refused, self._observer.fix(found, prior))
        return self._updated(seen, self._fusion.points(found))

    def _new_search(self) -> Relocalizer:
        config = self._config
        search = Relocalizer(
            self._map, self.calibration.mount, config.relocalization, config.odometry,
            config.observation,
        )  # fmt: skip
        if self._sample is not None:
            search.add_odometry(self._sample)
        return search

    def _search(self, frame: CameraFrame) -> PoseEstimate | Refusal:
        """Search for the place; the images from which it is found are not fused again."""
        assert self._relocalizer is not None, 'it searches'
        outcome = self._relocalizer.add_frame(straight(frame, self.calibration))
        if isinstance(outcome, Refusal):
            return outcome
        self._fusion.place(self._relocalizer.in_time, frame)
        self._relocalizer = None
        self._unseen.restart()
        return self._fusion.estimate(frame.stamp_ns) or outcome

    def _updated(self, seen: Observation, points: ImagePoints) -> LocalizationUpdate:
        """Correct the state by an image; return what came of it."""
        stamp, taken = points.stamp_ns, self._fusion.add_points(points)
        fused = self._fusion.estimate(stamp)
        assert fused is not None, 'a pose is known'
        status, reason = self._fusion.status_at()
        return LocalizationUpdate(
            stamp,
            _NO_TRIPLET,
            seen,
            self._fusion_update(stamp, taken),
            fused,
            _STATUS[status],
            reason,
            self._fusion.with_landmarks(stamp),
            level=self._fusion.level(fused),
            points=points,
        )

    def _fusion_update(self, stamp_ns: int, taken: Update | Refusal) -> FusionUpdate:
        if isinstance(taken, Refusal):
            return FusionUpdate(stamp_ns, refusal=taken)
        if not len(taken.columns):
            return FusionUpdate(stamp_ns, refusal=Refusal('nothing seen'))
        ids, good = self._map.ids[taken.columns], taken.weight > _OUTLIER
        squares = np.einsum(
            'mi,mi->m',
            taken.residual,
            np.linalg.solve(taken.covariance, taken.residual[..., None])[..., 0],
        )
        return FusionUpdate(
            stamp_ns,
            ids[good],
            taken.residual[good, 0],
            float(squares[good].sum()),
            int(good.sum()) * taken.residual.shape[1],
            {int(k): Refusal('outlier') for k in ids[~good]},
        )
