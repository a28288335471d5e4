"""Landmarks found with a camera that was knocked: it looks beside where its joints say."""

from __future__ import annotations

from dataclasses import replace
import logging

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.detection.config import DetectionConfig
from landmark_nav.localization.detection.correlation import detect_landmarks, DetectionResult
from landmark_nav.localization.detection.expectation import camera_in_map
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap, PoseEstimate

__all__ = ['AimedDetector']

_LOG = logging.getLogger(__name__)

# Shares of what should be in view: next to nothing, and what a camera that looks beside must show
# there; from a wrong place some landmarks may be mistaken for others, and agree on a tilt.
_HARDLY_ANY, _MOST = 0.25, 0.5
# So many landmarks tell a turned camera from chance.
_LEAST = 3
# A picture that turns out to be blurred otherwise than the last one is looked at again.
_LOOKS, _SAME_BLUR_PX2 = 3, 0.7
# No picture is sharper or more blurred than this and still of use.
_SHARPEST_PX2, _BLURRIEST_PX2 = -4.0, 25.0
# A tilt that is told: more than a floor does, and than heights that are a centimetre off.
_TILTED_RAD, _HEIGHT_M = 0.005, 0.01


class AimedDetector:
    """
    Searches where prior and joints say; if hardly anything is there, beside that as well.

    What it finds there tells by how much the camera looks beside, and where to search from then
    on. Bearings stay as the joints have them: what is wrong with those is for the filter to tell
    from a wrong heading. A wrong tilt concerns nobody else, and is put right here.

    Parameters
    ----------
    landmark_map : LandmarkMap
        What was learned.
    mount : PanTiltMount
        Where the camera turns.
    config : DetectionConfig
        Parameters.
    knock_rad : float
        How far beside to search; 0 does not.

    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        mount: PanTiltMount,
        config: DetectionConfig,
        knock_rad: float,
    ) -> None:
        self._map, self._mount, self._config, self._knock = landmark_map, mount, config, knock_rad
        self._aim, self._told_rad = np.zeros(2), 0.0
        self._blur = np.zeros(2)

    @property
    def tilt_rad(self) -> float:
        """By how much the camera looks higher than its joints say."""
        return float(self._aim[1])

    @property
    def knocked_up_rad(self) -> float:
        """`tilt_rad` where that is more than a floor does, else 0."""
        return self.tilt_rad if abs(self.tilt_rad) > _TILTED_RAD else 0.0

    def aimed(self, frame: CameraFrame) -> CameraFrame:
        """A picture with its joints as they turned out to be."""
        return _turned(frame, self._aim)

    def detect(
        self,
        frame: CameraFrame,
        prior: PoseEstimate,
        expected: npt.NDArray[np.intp],
        knocked: bool = True,
    ) -> DetectionResult:
        """
        Find landmarks `expected` (n,) of the map; as `detect_landmarks`.

        `knocked` tells whether a knock may be why they are missing.
        """
        knock, config = self._knock if knocked else 0.0, self._config
        result = self._search(frame, prior, expected, config, self._aim)
        few = len(result.detections) <= _HARDLY_ANY * len(expected)
        if not few or len(expected) < _LEAST or not knock:
            if self._tells(result, expected):
                self._follow(result, frame, prior)
            return result
        wide = replace(prior, covariance=prior.covariance + np.diag([0.0, 0.0, knock**2]))
        height = np.hypot(config.vertical_sigma_px, knock * frame.camera.fy)
        tall = replace(config, vertical_sigma_px=min(50.0, float(height)))
        beside = self._search(frame, wide, expected, tall, self._aim * [0.0, 1.0])
        if len(beside.detections) < _LEAST:
            return result
        # What is there by chance is not found again at one height.
        aim = self._seen_aim(beside, frame, prior)
        again = self._search(frame, wide, expected, config, aim)
        if not self._tells(again, expected):
            return result
        self._aim = aim
        self._follow(again, frame, prior)
        return again

    @staticmethod
    def _tells(result: DetectionResult, expected: npt.NDArray[np.intp]) -> bool:
        """Whether enough was found to tell how the camera looks."""
        return len(result.detections) >= max(_LEAST, _MOST * len(expected))

    def _follow(self, result: DetectionResult, frame: CameraFrame, prior: PoseEstimate) -> None:
        """Aim where a picture was found to look, once that is beside."""
        aim = self._seen_aim(result, frame, prior)
        away = self._map.positions[self._map.indices(result.detections.ids), :2] - prior.pose[:2]
        doubt_rad = _HEIGHT_M / float(np.median(np.hypot(*away.T)))
        tilted = abs(aim[1] - self._told_rad) > _TILTED_RAD + doubt_rad
        if tilted:
            self._told_rad = aim[1]
            side = 'above' if aim[1] > 0.0 else 'below'
            degrees = np.degrees(abs(aim[1]))
            _LOG.warning('camera looks %.1f deg %s where its joints say', degrees, side)
        if tilted or self._aim.any():
            self._aim = aim

    def _search(
        self,
        frame: CameraFrame,
        prior: PoseEstimate,
        expected: npt.NDArray[np.intp],
        config: DetectionConfig,
        aim: FloatArray,
    ) -> DetectionResult:
        """Search with the camera turned by an aim; bearings are those of the joints."""
        for _ in range(_LOOKS):
            result = detect_landmarks(
                _turned(frame, aim), prior, self._map, self._mount, config, expected, self._blur
            )
            if len(result.detections) < _LEAST:
                # What hides landmarks may be a blur that is gone.
                self._blur = 0.5 * self._blur
                break
            before, self._blur = self._blur, _blur_of(result)
            if np.abs(self._blur - before).max() < _SAME_BLUR_PX2:
                break
        bearing = wrap_rad(result.detections.bearing_rad - aim[0])
        return replace(result, detections=replace(result.detections, bearing_rad=bearing))

    def _seen_aim(
        self, found: DetectionResult, frame: CameraFrame, prior: PoseEstimate
    ) -> FloatArray:
        """
        Pan and tilt (2,) by which a picture is off, in radians: the median over what was found.

        Pan holds the error of the expected heading as well.
        """
        rotation, center = camera_in_map(prior.pose, self._mount, frame.pan_rad, frame.tilt_rad)
        expected = self._map.positions[self._map.indices(found.detections.ids)] - center
        seen = found.rays @ rotation.T
        return np.asarray(np.median(wrap_rad(_angles(expected) - _angles(seen)), axis=1))


def _turned(frame: CameraFrame, aim: FloatArray) -> CameraFrame:
    pan, tilt = frame.pan_rad + float(aim[0]), frame.tilt_rad + float(aim[1])
    return replace(frame, pan_rad=pan, tilt_rad=tilt)


def _blur_of(result: DetectionResult) -> FloatArray:
    """By how much more a picture is blurred than what was learned, variance (2,), pixels^2."""
    return np.clip(np.median(result.blur_px2, axis=0), _SHARPEST_PX2, _BLURRIEST_PX2)


def _angles(rays: FloatArray) -> FloatArray:
    """Azimuth and elevation (2, n) of rays (n, 3)."""
    x, y, z = rays.T
    return np.array([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
