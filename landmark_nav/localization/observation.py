"""Landmarks found in images, and the fixes triangulated from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
import logging

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.detection import DetectionConfig
from landmark_nav.localization.detection.aim import AimedDetector
from landmark_nav.localization.detection.correlation import DetectionResult
from landmark_nav.localization.detection.expectation import Expectation, NOT_LOOKED_FOR
from landmark_nav.localization.detection.height import CameraTilt
from landmark_nav.localization.detection.informative import most_informative
from landmark_nav.localization.detection.neighbour_consistency import NeighbourConsistency
from landmark_nav.localization.frozen_image import FrozenImage
from landmark_nav.localization.joint_delay import in_time, JointDelay, PanMotion
from landmark_nav.localization.looking import LookingConfig
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.prior_uncertainty import is_prior_uncertain
from landmark_nav.localization.relocalization.search import nothing_recognised
from landmark_nav.localization.relocalization.within_prior import localize_within_prior
from landmark_nav.localization.triangulation.bearing_buffer import BearingBuffer
from landmark_nav.localization.triangulation.model import axis_from_base
from landmark_nav.localization.triplet import visible_landmarks
from landmark_nav.parameters import parameter
from landmark_nav.types import (
    CameraFrame,
    Detections,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
    RefusalCode,
    Triplet,
)

__all__ = ['Observation', 'ObservationConfig', 'Observer']

_LOG = logging.getLogger(__name__)

# With a hardly known pose, fewer landmarks than this may all be mistaken.
_AGREE = 3
# A wide prior is narrowed by a search that takes a tenth of a second: in each of the first so many
# images, then, if nothing was found, in every third one.
_EAGER, _PATIENT = 5, 3
# Share of the landmarks looked for that counts as most of them.
_MOST = 0.75
# The novelty of a landmark is halved when it is looked for, and recovers by a fifth an image.
_NEW, _STILL_KNOWN = 0.5, 0.8
_IN_TIME = JointDelay()
_FROZEN = Refusal('image is the one before', 'though the camera has moved: it hangs')


@dataclass(frozen=True)
class ObservationConfig(LookingConfig):
    """Parameters of the stages that look at an image."""

    turned_sigma_rad: float = parameter(
        0.035,
        'How far a camera may be turned against the base, or tilted, by a knock: where hardly '
        'anything of what should be in view is found, it is searched this much wider; 0 does '
        'not, rad.',
        minimum=0.0,
        maximum=1.0,
    )


@dataclass(frozen=True, eq=False)
class Observation:
    """
    What an image says about the pose.

    Parameters
    ----------
    detections : Detections
        Landmarks that were found.
    refused : mapping of int to Refusal
        Why others were not, by landmark id.
    fix : PoseEstimate or Refusal
        Triangulated pose of the base, from the bearings of this image or of several. The prior
        only given where to look, and rejects impossible results.
    unusable : bool
        Whether the image was not searched at all.
    expected : mapping of int to Expectation
        Where landmarks were searched, by id.

    """

    detections: Detections
    refused: Mapping[int, Refusal]
    fix: PoseEstimate | Refusal
    unusable: bool = False
    expected: Mapping[int, Expectation] = field(default_factory=dict)


class Observer:
    """
    Finds landmarks in one image after the other, and triangulates.

    With triplets in one view each image gives a fix of its own. With several views detections
    are gathered, and give a fix when the chosen triplet is complete, or has been waited for too
    long.
    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        mount: PanTiltMount,
        config: ObservationConfig,
        odometry: OdometryNoiseConfig | None = None,
    ) -> None:
        self._map, self._mount, self._config = landmark_map, mount, config
        self._detector = AimedDetector(
            landmark_map, mount, config.detection, config.turned_sigma_rad
        )
        _warn_without_views(landmark_map, config.detection)
        window_s = config.triplet.fix_window_s if config.triplet.views == 'several' else 0.0
        self._vain = 0
        self._found_most = False
        self._novelty = np.ones(len(landmark_map.landmarks))
        self._neighbours = NeighbourConsistency(landmark_map)
        self._frozen = FrozenImage()
        self._window_ns = int(1e9 * window_s)
        self._waits_since_ns = np.inf
        self._bearing_buffer = BearingBuffer(
            landmark_map,
            mount,
            window_s,
            odometry or OdometryNoiseConfig(),
            config.triangulation,
        )

    @property
    def tilt_change_rad(self) -> float:
        """How much higher the camera looks than its joints say; 0 unless it was displaced."""
        return self._detector.tilt_change_rad

    @property
    def roll_change_rad(self) -> float:
        """Roll of the camera to its right; 0 unless it was displaced."""
        return self._detector.roll_change_rad

    def turn(self, tilt_rad: float, roll_rad: float) -> None:
        """Take the camera to be tilted up so much more, and rolled so much more to its right."""
        self._detector.turn(tilt_rad, roll_rad)

    @property
    def camera_tilt(self) -> CameraTilt:
        """Tilt and roll of the camera beyond those of its joints, however small."""
        return self._detector.camera_tilt

    def add_odometry(self, sample: OdometrySample) -> None:
        """Move on."""
        self._frozen.add_odometry(sample)
        self._bearing_buffer.add_odometry(sample)

    def look(
        self,
        frame: CameraFrame,
        prior: PoseEstimate,
        triplet: Triplet | Refusal | None = None,
        late: JointDelay = _IN_TIME,
    ) -> Observation:
        """
        Detect what should be in view and triangulate.

        Parameters
        ----------
        frame : CameraFrame
            Image with its joint angles.
        prior : PoseEstimate
            Expected pose of the base at its stamp.
        triplet : Triplet, optional
            Landmarks that the camera was turned to. They are looked for first, and with several
            views a fix waits for all three, for up to `fix_window_s` after the one before.
        late : JointDelay, optional
            Delay of the stamps of the joints.

        """
        if self._frozen.repeats(frame):
            return Observation(_nothing(frame.stamp_ns), {}, _FROZEN, unusable=True)
        config = self._config
        frame, pan_sigma = in_time(frame, late)
        wide = is_prior_uncertain(prior.covariance)
        place = self._localize_within_prior(frame, prior) if wide else prior
        known = not isinstance(place, Refusal)
        looked_from = prior if isinstance(place, Refusal) else place
        self._vain = 0 if known else self._vain + 1
        visible = visible_landmarks(
            looked_from,
            self._map,
            frame.camera,
            self._mount,
            frame.pan_rad,
            frame.tilt_rad,
            config.triplet,
        )
        wanted = (
            np.flatnonzero((self._map.ids[:, None] == triplet.ids).any(axis=1))
            if isinstance(triplet, Triplet)
            else ()
        )
        # An error of the pan shifts the image as one of the heading does.
        turned = np.diag([0.0, 0.0, pan_sigma**2])
        looked = replace(looked_from, covariance=looked_from.covariance + turned)
        result = self._detected(frame, looked, visible, wanted, not wide)
        # What an image cuts off, or shows too small, is no evidence.
        looked_for = (k for k, why in result.refused.items() if why.reason not in NOT_LOOKED_FOR)
        missed = np.array(sorted(looked_for), dtype=np.int64)
        found, refused = result.detections, dict(result.refused)
        if not known and len(found) < _AGREE:
            # So few matches may all be mistaken.
            alone = Refusal('the expected pose is hardly known', f'{len(found)} found in all')
            refused.update(dict.fromkeys(found.ids.tolist(), alone))
            found = found.chosen(np.zeros(len(found), dtype=np.bool_))
        if len(found):
            found = self._with_neighbour_variance(found, missed, looked)
        pan_motion = PanMotion.of(frame, self._mount)
        found = replace(
            found,
            missed=missed,
            pan_rate_rad_s=pan_motion.rate_rad_s,
            pan_sigma_rad=frame.pan_sigma_rad,
            pan_rad=pan_motion.azimuth_rad,
            pan_track=pan_motion.track,
            pan_delay_s=late.delay_s,
        )
        fix = self._fix(found, prior, triplet)
        return Observation(found, refused, fix, expected=result.expected)

    def _detected(
        self,
        frame: CameraFrame,
        prior: PoseEstimate,
        visible: npt.NDArray[np.intp],
        wanted: npt.ArrayLike,
        known: bool,
    ) -> DetectionResult:
        """
        Look for some of the `visible` (n,) landmarks, first of all for those `wanted`.

        As long as most are found, a few are enough. Otherwise all are looked for, to distinguish a
        camera that was displaced from a view that has changed; a knock is ruled out unless the
        pose is `known`.
        """
        config, sigma = self._config.detection, self._config.triplet.bearing_sigma_rad
        axis = axis_from_base(prior, self._mount)
        enough, most = min(config.target_count, config.max_count), config.max_count
        few_first = self._found_most and enough < min(most, len(visible))
        for count in (enough, most) if few_first else (most,):
            expected = most_informative(
                axis, self._map, visible, sigma, count, wanted, self._novelty
            )
            result = self._detector.detect(
                frame, prior, expected, displaced=known and count == most, tells=known
            )
            self._found_most = len(result.detections) >= _MOST * len(expected)
            if self._found_most:
                break
        self._novelty = 1.0 - _STILL_KNOWN * (1.0 - self._novelty)
        self._novelty[expected] *= _NEW
        return result

    def _with_neighbour_variance(
        self, found: Detections, missed: npt.NDArray[np.int64], prior: PoseEstimate
    ) -> Detections:
        """Bearings, less certain where the neighbours of a landmark were not found."""
        columns = self._map.indices(found.ids)
        self._neighbours.note(columns, self._map.indices(missed))
        away = self._map.positions[columns, :2] - axis_from_base(prior, self._mount).pose[:2]
        across = self._neighbours.variance_m2(columns) / np.sum(away**2, axis=1)
        return replace(found, variance_rad2=found.variance_rad2 + across)

    def _localize_within_prior(
        self, frame: CameraFrame, prior: PoseEstimate
    ) -> PoseEstimate | Refusal:
        """Find the pose within a wide prior; if that fails again and again, try less often."""
        if self._vain > _EAGER and self._vain % _PATIENT:
            return nothing_recognised('neither in the images before')
        seen = self._detector.levelled(frame), prior, self._map, self._mount, self._config
        place = localize_within_prior(*seen)
        unrecognised = isinstance(place, Refusal) and place.code is RefusalCode.UNRECOGNISED
        if unrecognised and self._vain and self._config.turned_sigma_rad:
            # Not only in this image: the camera may have been displaced.
            relocated = localize_within_prior(*seen, self._config.turned_sigma_rad)
            place = place if isinstance(relocated, Refusal) else relocated
        if isinstance(place, Refusal):
            return place
        self.turn(place.tilt_rad, place.roll_rad)
        return place.estimate

    def take(self, found: Detections, prior: PoseEstimate) -> Observation:
        """Triangulate from landmarks that somebody else found, leaving out unknown ones."""
        known = np.isin(found.ids, self._map.ids)
        unknown = {int(k): Refusal('not in the map') for k in found.ids[~known]}
        found = found if known.all() else found.chosen(known)
        return Observation(found, unknown, self._fix(found, prior, None))

    def _fix(
        self, found: Detections, prior: PoseEstimate, triplet: Triplet | Refusal | None
    ) -> PoseEstimate | Refusal:
        self._bearing_buffer.add(found)
        if self._window_ns and isinstance(triplet, Triplet):
            # From the first choice after a fix on: later ones would begin the wait anew.
            self._waits_since_ns = min(self._waits_since_ns, triplet.stamp_ns)
            missing = self._bearing_buffer.missing(triplet)
            if missing and found.stamp_ns - self._waits_since_ns <= self._window_ns:
                names = ', '.join(map(str, missing))
                return Refusal('the triplet is not complete', f'{names} still to be found')
        fix = self._bearing_buffer.fix(prior)
        if isinstance(fix, PoseEstimate):
            self._waits_since_ns = np.inf
        return fix


def _nothing(stamp_ns: int) -> Detections:
    none = np.empty(0)
    return Detections(stamp_ns, none.astype(np.int64), none, none, none, none.reshape(0, 2))


def _warn_without_views(landmark_map: LandmarkMap, config: DetectionConfig) -> None:
    """Warn of a map of an older version, whose landmarks have patches but no views."""
    with_images = [k for k in landmark_map.landmarks if k.patch.size]
    if (
        config.appearance == 'virtual_view'
        and with_images
        and not any(k.views for k in with_images)
    ):
        _LOG.warning(
            'the map holds no views of other panoramas: landmarks are looked for as their '
            'patches show them; learn the map again for virtual views'
        )
