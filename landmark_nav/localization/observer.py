"""
Detection of landmarks where the state of the estimator expects them; fixes from their bearings.

The calibrated extrinsics give the pose of the camera; the joint covariance of pose and extrinsics
gives the search windows. So an uncertain state widens the search, and calibration narrows it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IndexArray
from landmark_nav.calibration import Calibration, LENS
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.geometry.se2 import relative
from landmark_nav.localization.detection.correlation import detect_blurred, DetectionResult
from landmark_nav.localization.detection.expectation import Expectation as Window
from landmark_nav.localization.detection.expectation import NOT_LOOKED_FOR, quadratic, View
from landmark_nav.localization.estimator.config import EstimatorConfig
from landmark_nav.localization.estimator.factors import image_points
from landmark_nav.localization.image_stages import ImageStagesConfig
from landmark_nav.localization.relocalization.search import localize_within_prior
from landmark_nav.localization.relocalization.verification import PlaceVerifier
from landmark_nav.localization.start import is_prior_uncertain
from landmark_nav.localization.triangulation.model import (
    axis_from_base,
    base_from_axis,
    bearing_gradients,
)
from landmark_nav.localization.triangulation.robust import triangulate
from landmark_nav.localization.triplet.visibility import visible_landmarks
from landmark_nav.types import (
    CameraFrame,
    Detections,
    Expectation,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)

# A camera that turned or moved by more than this must see another image.
_MOVED_PX, _MOVED_M = 1.0, 0.02
_FEW_THEN_ALL = slice(None, None, 16), slice(None)


class FrozenImage:
    """
    Detects images that equal an earlier one although the camera has moved.

    Joints and odometry (`pose_odom`) show whether it has moved: a pose in map is also corrected at
    rest.
    """

    def __init__(self) -> None:
        self.pose_odom: FloatArray = np.zeros(3)
        self._first: tuple[CameraFrame, FloatArray] | None = None

    def repeats(self, frame: CameraFrame) -> bool:
        """Whether an image is identical to one from another pose."""
        before, there = self._first or (None, self.pose_odom)
        # A few rows distinguish almost all images.
        same = before is not None and all(
            np.array_equal(frame.image[rows], before.image[rows]) for rows in _FEW_THEN_ALL
        )
        if before is None or not same:
            self._first = frame, self.pose_odom
            return False
        if not np.ptp(frame.image):
            # If the lens is covered, all images are the same.
            return False
        forward, left, heading = relative(there, self.pose_odom).tolist()
        aside = wrap_rad(frame.pan_rad + heading - before.pan_rad)
        turn = max(abs(float(aside)), abs(frame.tilt_rad - before.tilt_rad))
        return turn * frame.camera.fx > _MOVED_PX or np.hypot(forward, left) > _MOVED_M


def most_informative(
    axis: PoseEstimate,
    landmark_map: LandmarkMap,
    index: npt.NDArray[np.intp],
    bearing_sigma: float,
    count: int,
    novelty: FloatArray | None = None,
) -> npt.NDArray[np.intp]:
    """
    Choose landmarks greedily by their contribution to the information about the pose.

    A bearing of variance r and derivative h multiplies the determinant of the information by
    ``1 + h P h^T / r``; r includes the landmark's own error. The greedy choice gains at least 63 %
    of the optimum (Krause, Singh and Guestrin, JMLR 9, 2008).

    Parameters
    ----------
    axis : PoseEstimate
        Expected pose of the pan axis.
    index : ndarray of int, shape (n,)
        Indices of the candidates in the map.
    bearing_sigma : float
        Expected measurement sigma, rad.
    novelty : ndarray, shape (landmarks of the map,), optional
        Factor on the gain of each landmark: a landmark seen before repeats its error.

    Returns
    -------
    ndarray of int, shape (min(n, count),)
        Chosen indices in the order of the map.
    """
    if len(index) <= count:
        return index
    gradient = bearing_gradients(axis.pose, landmark_map.positions[index, :2])
    variance = bearing_sigma**2 + quadratic(gradient, landmark_map.covariances[index, :2, :2])
    rows = np.column_stack([gradient, np.full(len(index), -1.0)]) / np.sqrt(variance)[:, None]
    covariance: FloatArray = axis.covariance
    gain = np.sum(rows @ covariance * rows, -1)
    left = np.ones(len(index), dtype=np.bool_)
    news = np.ones(len(index)) if novelty is None else novelty[index]
    for _ in range(count):
        best = int(np.argmax(np.where(left, news * gain, -np.inf)))
        left[best] = False
        spread = covariance @ rows[best] / np.sqrt(1.0 + gain[best])
        covariance = covariance - spread[:, None] * spread
        gain -= (rows @ spread) ** 2
    return np.asarray(index[~left], dtype=np.intp)


# Shares of the searched landmarks that count as most of them, and as hardly any.
_MOST, _HARDLY_ANY = 0.75, 0.25
# Largest vertical sigma of the search, pixels.
_MOST_RISE_PX = 50.0
# The novelty of a landmark is halved when it is searched, and recovers by a fifth per image.
_NEW, _STILL_KNOWN = 0.5, 0.8
# Resolution of the corrections of the lens when templates are rendered, in focal lengths.
_STEP = 4e-4
# A search within a wide prior takes a tenth of a second: it is done in this number of first
# images, then, if nothing was found, in every third one.
_EAGER, _PATIENT = 5, 3
_HANGS = Refusal('image is the one before', 'though the camera has moved: it hangs')


@dataclass(frozen=True, eq=False)
class Observation:
    """
    Results of the detection in one image.

    Parameters
    ----------
    detections : Detections
        Landmarks that were found.
    refused : mapping of int to Refusal
        Why others were not, by landmark id.
    triangulate : callable
        Computes `fix` on demand.
    unusable : bool
        Whether the image was not searched at all.
    expected : mapping of int to Window
        Where landmarks were searched, by id.
    """

    detections: Detections
    refused: Mapping[int, Refusal]
    triangulate: Callable[[], PoseEstimate | Refusal]
    unusable: bool = False
    expected: Mapping[int, Window] = field(default_factory=dict)

    @cached_property
    def fix(self) -> PoseEstimate | Refusal:
        """Pose of the base triangulated from the bearings of this image alone."""
        return self.triangulate()


def straight(
    frame: CameraFrame, calibration: Calibration, turn_rate_rad_s: float = 0.0
) -> CameraFrame:
    """Return an image with camera and joints corrected by a calibration; the base may turn."""
    delay_s, track = calibration['joint_delay'][0], frame.pan_track
    pan = frame.pan_rad
    if track is None:
        pan += frame.pan_rate_rad_s * delay_s
    else:
        given, lagged = track.at([0.0, delay_s]).tolist()
        pan = pan + lagged - given
    lens = (_STEP * round(calibration[name][0] / _STEP) for name in LENS)
    return replace(
        frame,
        camera=_calibrated(frame.camera, *lens),
        pan_rad=pan * (1.0 + calibration['pan_scale'][0]),
        tilt_rad=frame.tilt_rad + calibration['camera_tilt'][0],
        row_turn_rad=calibration['row_delay'][0] * _turning(frame, calibration, turn_rate_rad_s),
    )


def _turning(frame: CameraFrame, calibration: Calibration, turn_rate_rad_s: float) -> float:
    """Rate of the azimuth of the camera, to the left."""
    return calibration.base.pan_sense * frame.pan_rate_rad_s + turn_rate_rad_s


@lru_cache(maxsize=8)
def _calibrated(camera: CameraModel, focal: float, shift: float, distortion: float) -> CameraModel:
    """Return one object for equal values: it caches tables of its lens."""
    return camera.adjusted(1.0 + focal, shift, distortion)


class Observer:
    """
    Finds landmarks in a sequence of images.

    Parameters
    ----------
    calibration : Calibration
        Prior of mount, lens and clocks.
    config : ImageStagesConfig
        Parameters of the stages of detection.
    step : EstimatorConfig
        Sigmas of sudden changes of camera and base.
    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        calibration: Calibration,
        config: ImageStagesConfig,
        step: EstimatorConfig,
    ) -> None:
        self._map, self._config, self._step = landmark_map, config, step
        self._mount = calibration.mount
        self._frozen = FrozenImage()
        self._blur, self._found_most, self._vain = np.zeros(2), False, 0
        self._novelty = np.ones(len(landmark_map.landmarks))

    def add_odometry(self, sample: OdometrySample) -> None:
        """Add a sample of odometry."""
        self._frozen.pose_odom = sample.pose_odom_base

    def fix(self, found: Detections, prior: PoseEstimate) -> PoseEstimate | Refusal:
        """Triangulate from the bearings of one image; the prior rejects implausible results."""
        index = self._map.indices(found.ids)
        pan_variance = self._mount.pan_sigma_rad**2 + found.pan_sigma_rad**2
        start = axis_from_base(prior, self._mount)
        away = self._map.positions[index, :2] - start.pose[:2]
        # An error of the pan shifts all landmarks across their lines of sight.
        across = np.column_stack([-away[:, 1], away[:, 0]]).ravel()
        covariance = self._map.joint_covariance_of(index)
        fix = triangulate(
            self._map.positions[index, :2],
            found.bearing_rad,
            found.variance_rad2,
            covariance + pan_variance * np.outer(across, across),
            start,
            self._config.triangulation,
        )
        if isinstance(fix, Refusal):
            return fix
        return base_from_axis(fix.at(found.stamp_ns), self._mount)

    def look(self, frame: CameraFrame, expected: Expectation) -> Observation:
        """
        Search visible landmarks: only a few as long as most of them are found.

        If hardly any is found, more are searched where they should be after a sudden change of
        camera or base. An uncertain pose is first located by the image: `Detections.near`.
        """
        if self._frozen.repeats(frame):
            none = np.empty(0)
            empty = Detections(
                frame.stamp_ns, none.astype(int), none, none, none, np.empty((0, 2))
            )
            return Observation(empty, {}, lambda: _HANGS, unusable=True)
        config = self._config
        place = self._narrowed(frame, expected)
        if place is not None:
            expected = replace(expected, pose=place.pose, covariance=place.covariance)
        upright = straight(frame, expected.calibration, expected.turn_rate_rad_s)
        pan, tilt, mount = upright.pan_rad, upright.tilt_rad, expected.calibration.mount
        visible = visible_landmarks(
            expected, self._map, upright.camera, mount, pan, tilt, config.triplet
        )
        most = config.detection.max_count
        enough = min(config.detection.target_count, most)
        tries = [(False, enough)] if self._found_most and enough < len(visible) else []
        for turned, count in [*tries, (False, most), (True, most)]:
            state = expected.stepped(*self._step.zoom[1:]) if turned else expected
            result, looked_for = self._searched(frame, upright, state, visible, count)
            found = len(result.detections)
            self._found_most = found >= _MOST * len(looked_for)
            if self._found_most or (count == most and found > _HARDLY_ANY * len(looked_for)):
                break
        self._novelty = 1.0 - _STILL_KNOWN * (1.0 - self._novelty)
        self._novelty[looked_for] *= _NEW
        missed = [k for k, why in result.refused.items() if why.reason not in NOT_LOOKED_FOR]
        seen, places = result.detections, result.expected
        sizes = np.array([places[k].size for k in seen.ids.tolist()]).reshape(-1, 2)
        points, covariance, by_lens = image_points(
            seen.uv_px, seen.covariance_px2, frame.camera, upright.camera, result.rays
        )
        seen = replace(
            seen,
            missed=np.array(sorted(missed), dtype=np.int64),
            pan_sigma_rad=frame.pan_sigma_rad,
            pan_rad=float(mount.azimuth_base_rad(frame.pan_rad)),
            points=points,
            point_covariance=covariance,
            by_lens=by_lens,
            below=(seen.uv_px[:, 1] - frame.camera.cy) / frame.camera.fy,
            sizes=sizes / [frame.camera.fx, frame.camera.fy],
            near=None if place is None else place.pose,
            intrinsics=frame.camera.intrinsics,
        )
        return Observation(
            seen, result.refused, lambda: self.fix(seen, expected), expected=result.expected
        )

    def _narrowed(self, frame: CameraFrame, expected: Expectation) -> PoseEstimate | None:
        """Find the pose within a wide prior; after repeated failures this is tried less often."""
        if not is_prior_uncertain(expected.covariance):
            self._vain = 0
            return None
        self._vain += 1
        if self._vain > _EAGER and self._vain % _PATIENT:
            return None
        known = expected.calibration
        verifier = PlaceVerifier(self._map.distinct, known.mount, self._config)
        upright = straight(frame, known, expected.turn_rate_rad_s)
        place = localize_within_prior(upright, expected, verifier)
        if isinstance(place, Refusal):
            return None
        self._vain = 0
        return place.estimate

    def _searched(
        self,
        frame: CameraFrame,
        upright: CameraFrame,
        expected: Expectation,
        visible: IndexArray,
        count: int,
    ) -> tuple[DetectionResult, IndexArray]:
        """Search `count` of the visible landmarks; `upright` is the frame `straight`ened."""
        config, mount = self._config, expected.calibration.mount
        # An error of the pan shifts the image like one of the heading.
        pan = expected.pan_sigma_rad(frame.pan_rate_rad_s)
        # An error of the focal length shifts it by most at its border.
        focal, camera = expected.calibration['focal_scale'][1], frame.camera
        lens = 0.5 * focal * camera.width / camera.fx
        # A rolling shutter shifts its highest and lowest rows most.
        turning = _turning(frame, expected.calibration, expected.turn_rate_rad_s)
        late = 0.5 * expected.calibration['row_delay'][1] * camera.height / camera.fy
        squares = [pan, frame.pan_sigma_rad, lens, late * turning]
        turned = np.diag([0.0, 0.0, float(np.sum(np.square(squares)))])
        rises_px = camera.fy * expected.tilt_sigma_rad, 0.5 * focal * camera.height
        rise_px = np.linalg.norm([config.detection.vertical_sigma_px, *rises_px])
        detection = replace(config.detection, vertical_sigma_px=min(_MOST_RISE_PX, float(rise_px)))
        shifted = replace(expected, covariance=expected.covariance + turned)
        looked_for = most_informative(
            axis_from_base(expected, mount), self._map, self._distinct(visible, shifted),
            config.triplet.bearing_sigma_rad, count, self._novelty,
        )  # fmt: skip
        view = View(upright, shifted, mount)
        result, self._blur = detect_blurred(view, self._map, detection, looked_for, self._blur)
        return result, looked_for

    def _distinct(self, visible: IndexArray, expected: PoseEstimate) -> IndexArray:
        """Landmarks without edges in wide windows, or without any if there are enough others."""
        edges = self._map.edges[visible]
        if np.sum(~edges) >= self._config.detection.target_count:
            return np.asarray(visible[~edges])
        away = self._map.positions[visible, :2] - expected.pose[:2]
        squared = np.sum(away**2, axis=1)
        variance = expected.covariance[2, 2] + np.trace(expected.covariance[:2, :2]) / squared
        half_rad = self._config.detection.window_sigmas * np.sqrt(variance)
        wide = half_rad > self._map.sizes_m[visible, 0] / np.sqrt(squared)
        return np.asarray(visible[~(wide & edges)])
