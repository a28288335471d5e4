"""
Localization, stage by stage.

picture and prior -> triplet, detection, triangulation; bearings and odometry -> fusion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.active_camera import ActiveCamera
from landmark_nav.localization.detection import detect_landmarks, DetectionConfig
from landmark_nav.localization.fusion import FusionConfig, FusionUpdate, PoseFilter
from landmark_nav.localization.fusion_health import HealthConfig
from landmark_nav.localization.odometry_noise import OdometryNoiseConfig
from landmark_nav.localization.relocalization import RelocalizationConfig
from landmark_nav.localization.relocalization_stream import Relocalizer
from landmark_nav.localization.triangulation import triangulate, TriangulationConfig
from landmark_nav.localization.triangulation_model import axis_from_base, base_from_axis
from landmark_nav.localization.triplet import Gaze, TripletConfig, visible_landmarks
from landmark_nav.localization.worth import most_telling
from landmark_nav.types import (
    CameraFrame,
    Detections,
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
    'Observation',
    'ObservationConfig',
    'fix_from_bearings',
    'observe',
]


@dataclass(frozen=True)
class ObservationConfig:
    """Parameters of the stages that look at a picture."""

    triplet: TripletConfig = field(default_factory=TripletConfig)
    detection: DetectionConfig = field(default_factory=DetectionConfig)
    triangulation: TriangulationConfig = field(default_factory=TriangulationConfig)


@dataclass(frozen=True)
class LocalizationConfig:
    """Parameters of all stages."""

    observation: ObservationConfig = field(default_factory=ObservationConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    odometry: OdometryNoiseConfig = field(default_factory=OdometryNoiseConfig)
    health: HealthConfig = field(default_factory=HealthConfig)
    relocalization: RelocalizationConfig = field(default_factory=RelocalizationConfig)


@dataclass(frozen=True, eq=False)
class Observation:
    """
    What a picture says about the pose.

    `fix` is the triangulated pose of the base, computed from the bearings alone; the prior told
    where to look, and rejects what cannot be.
    """

    detections: Detections
    refused: Mapping[int, Refusal]
    fix: PoseEstimate | Refusal


def observe(
    frame: CameraFrame,
    prior: PoseEstimate,
    landmark_map: LandmarkMap,
    mount: PanTiltMount,
    config: ObservationConfig,
    common_bearing_sigma_rad: float = 0.0,
) -> Observation:
    """
    Detect what should be in view and triangulate.

    Parameters
    ----------
    frame : CameraFrame
        Picture with its joint angles.
    prior : PoseEstimate
        Expected pose of the base at its stamp.
    landmark_map : LandmarkMap
        What was learned.
    mount : PanTiltMount
        Where the camera turns.
    config : ObservationConfig
        Parameters.
    common_bearing_sigma_rad : float
        What all bearings of the picture share: the error of the measured pan.

    Returns
    -------
    Observation

    """
    expected = visible_landmarks(
        prior, landmark_map, frame.camera, mount, frame.pan_rad, frame.tilt_rad, config.triplet
    )
    expected = most_telling(
        axis_from_base(prior, mount),
        landmark_map,
        expected,
        config.triplet.bearing_sigma_rad,
        config.detection.max_count,
    )
    result = detect_landmarks(frame, prior, landmark_map, mount, config.detection, expected)
    fix = fix_from_bearings(
        result.detections, prior, landmark_map, mount, config, common_bearing_sigma_rad
    )
    missed = np.array(sorted(result.refused), dtype=np.int64)
    found = replace(result.detections, missed=missed, pan_rate_rad_s=frame.pan_rate_rad_s)
    return Observation(found, result.refused, fix)


def fix_from_bearings(
    found: Detections,
    prior: PoseEstimate,
    landmark_map: LandmarkMap,
    mount: PanTiltMount,
    config: ObservationConfig,
    common_bearing_sigma_rad: float = 0.0,
) -> PoseEstimate | Refusal:
    """Triangulate the base from the bearings of one picture; parameters as for `observe`."""
    index = landmark_map.indices(found.ids)
    rows = np.stack([2 * index, 2 * index + 1], -1).reshape(-1)
    fix = triangulate(
        landmark_map.positions[index, :2],
        found.bearing_rad,
        found.variance_rad2,
        landmark_map.joint_covariance_xy[np.ix_(rows, rows)],
        start=axis_from_base(prior, mount),
        config=config.triangulation,
        common_variance=common_bearing_sigma_rad**2,
    )
    return fix if isinstance(fix, Refusal) else base_from_axis(fix.at(found.stamp_ns), mount)


@dataclass(frozen=True, eq=False)
class LocalizationUpdate:
    """
    All that came of one picture.

    `triplet` is what the camera would best be turned to from here; `fused` is the filter's
    estimate at the picture's stamp, after it; `search` is what came of looking for the place, if
    it was lost.
    """

    stamp_ns: int
    triplet: Triplet | Refusal
    observation: Observation
    fusion: FusionUpdate
    fused: PoseEstimate
    status: str
    reason: str
    search: PoseEstimate | Refusal | None = None


class Localizer:
    """
    The nodes of the navigation phase in one: for bags, and for use without ROS.

    Without `initialize`, and when lost, it gathers pictures until they fit one place only.

    Parameters
    ----------
    landmark_map : LandmarkMap
        What was learned.
    mount : PanTiltMount
        Where the camera turns.
    config : LocalizationConfig
        Parameters.
    pan_limits_rad : tuple of float
        How far the camera turns.

    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        mount: PanTiltMount,
        config: LocalizationConfig,
        pan_limits_rad: tuple[float, float] = (-np.pi, np.pi),
    ) -> None:
        self._map, self._mount, self._config = landmark_map, mount, config
        self._filter = PoseFilter(
            landmark_map, mount, config.fusion, config.odometry, config.health
        )
        self._camera = ActiveCamera(landmark_map, mount, config.observation.triplet)
        self._gaze = Gaze(limits_rad=pan_limits_rad)
        self._odometry: OdometrySample | None = None
        self._relocalizer: Relocalizer | None = self._new_search()

    def _new_search(self) -> Relocalizer:
        config = self._config
        search = Relocalizer(self._map, self._mount, config.relocalization, config.odometry)
        if self._odometry is not None:
            search.add_odometry(self._odometry)
        return search

    def initialize(self, start: PoseEstimate) -> None:
        """Start anew at a pose of the base."""
        self._filter.initialize(start)
        self._relocalizer = None

    def add_odometry(self, sample: OdometrySample) -> Refusal | None:
        """Move on; why the sample was left out, if it was."""
        self._odometry = sample
        if self._relocalizer is not None:
            self._relocalizer.add_odometry(sample)
        return self._filter.add_odometry(sample)

    def estimate(self, stamp_ns: int | None = None) -> PoseEstimate | None:
        """Pose of the base at a time, the newest by default; None before one is known."""
        return self._filter.estimate(stamp_ns)

    def add_frame(self, frame: CameraFrame) -> LocalizationUpdate | PoseEstimate | Refusal:
        """
        Look at a picture and correct the pose.

        Returns
        -------
        LocalizationUpdate or PoseEstimate or Refusal
            While the place is not known, why not; the pose of the base in the picture it is found
            with.

        """
        prior = self._filter.estimate(frame.stamp_ns)
        if prior is None:
            return self._search(frame)
        config = self._config
        gaze = replace(self._gaze, pan_rad=frame.pan_rad, tilt_rad=frame.tilt_rad)
        triplet = self._camera.choose(prior, frame.camera, gaze).chosen
        seen = observe(
            frame,
            prior,
            self._map,
            self._mount,
            config.observation,
            config.fusion.pan_sigma_rad,
        )
        self._camera.saw(seen.detections)
        update = self._fused(frame.stamp_ns, triplet, seen)
        lost = update.status == 'lost' and config.relocalization.when_lost
        if not lost or not self._map.landmarks:
            self._relocalizer = None
            return update
        self._relocalizer = self._relocalizer or self._new_search()
        outcome = self._search(frame)
        if isinstance(outcome, PoseEstimate):
            status, reason = self._filter.status
            update = replace(update, fused=outcome, status=status, reason=reason)
        return replace(update, search=outcome)

    def _search(self, frame: CameraFrame) -> PoseEstimate | Refusal:
        """Find the place; what the pose was made of is not used again."""
        assert self._relocalizer is not None, 'no pose is known'
        outcome = self._relocalizer.add_frame(frame)
        if isinstance(outcome, PoseEstimate):
            self.initialize(outcome)
        return outcome

    def add_detections(self, found: Detections) -> LocalizationUpdate | Refusal:
        """Correct the pose by bearings that were found elsewhere; as `add_frame` otherwise."""
        prior = self._filter.estimate(found.stamp_ns)
        if prior is None:
            return Refusal('not initialized', 'give a start pose')
        found, unknown = _on_the_map(found, self._map)
        fix = fix_from_bearings(
            found,
            prior,
            self._map,
            self._mount,
            self._config.observation,
            self._config.fusion.pan_sigma_rad,
        )
        no_view = Refusal('no picture', 'the bearings were found elsewhere')
        return self._fused(found.stamp_ns, no_view, Observation(found, unknown, fix))

    def _fused(
        self, stamp_ns: int, triplet: Triplet | Refusal, seen: Observation
    ) -> LocalizationUpdate:
        """Correct the filter by what was seen."""
        if self._config.fusion.mode == 'bearings':
            update = self._filter.add_detections(seen.detections)
        elif isinstance(seen.fix, PoseEstimate):
            update = self._filter.add_pose(seen.fix)
        else:
            update = FusionUpdate(stamp_ns, refusal=seen.fix)
        fused = self._filter.estimate(stamp_ns)
        assert fused is not None, 'it was initialized'
        status, reason = self._filter.status
        return LocalizationUpdate(stamp_ns, triplet, seen, update, fused, str(status), reason)


def _on_the_map(
    found: Detections, landmark_map: LandmarkMap
) -> tuple[Detections, dict[int, Refusal]]:
    """Split off what the map does not hold."""
    known = np.isin(found.ids, landmark_map.ids)
    unknown = {int(k): Refusal('not in the map') for k in found.ids[~known]}
    return found if known.all() else found.chosen(known), unknown
