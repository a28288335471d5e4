"""Detection with a camera that was displaced, so that its direction is not that of its joints."""

from __future__ import annotations

from dataclasses import replace
import logging
from statistics import median

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.detection.blurred import detect_blurred
from landmark_nav.localization.detection.config import DetectionConfig
from landmark_nav.localization.detection.correlation import DetectionResult
from landmark_nav.localization.detection.expectation import LEAST_WINDOW_PX
from landmark_nav.localization.detection.height import (
    CAMERA_HEIGHT_SIGMA_M,
    CameraTilt,
    estimate_camera_tilt,
    TILTED_RAD,
)
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap, PoseEstimate

__all__ = ['AimedDetector', 'degrees_aside']

_LOG = logging.getLogger(__name__)

# Shares of the expected landmarks: if hardly any are found, a knock is suspected; a new direction
# is believed if most are found with it, as a few mistaken matches may agree on a tilt.
_HARDLY_ANY, _MOST = 0.25, 0.5
# It takes so many landmarks to tell a turned camera from chance.
_LEAST = 3
# Why matches are refused if the camera has a roll that is not known.
_BESIDE = ('wrong height', 'peak at the border of the search window')
# Most bearings of a camera that leans are off by one angle, but for so much, and for this share of
# the angle that the position may be off by.
_APART_RAD, _APART_SHARE = 0.001, 0.5
# Each later image that tells the roll as well as that corrects it by this share.
_ROLL_SHARE = 0.2


class AimedDetector:
    """
    Searches where prior and joints say, and, if hardly any landmark is there, further around.

    What is found there tells how far the camera's direction is off, and later images are
    searched with that correction. Tilt and roll are corrected here. Bearings stay as the joints
    have them: the filter has to tell an error of the pan from one of the heading.

    Parameters
    ----------
    knock_rad : float
        How much further to search; 0 for not at all.

    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        mount: PanTiltMount,
        config: DetectionConfig,
        knock_rad: float,
    ) -> None:
        self._map, self._mount, self._config, self._knock = landmark_map, mount, config, knock_rad
        # Corrections of pan, tilt and roll, and the tilt that was logged last.
        self._aim, self._told_rad = np.zeros(3), 0.0
        self._blur = np.zeros(2)

    @property
    def tilt_rad(self) -> float:
        """By how much the tilt is larger than its joint says."""
        return float(self._aim[1])

    @property
    def tilt_change_rad(self) -> float:
        """By how much the camera looks higher; 0 unless it is more than an uneven floor causes."""
        return self._mount.pan_sense * self.tilt_rad if abs(self.tilt_rad) > TILTED_RAD else 0.0

    @property
    def roll_change_rad(self) -> float:
        """Roll of the camera to its right; 0 unless it was displaced."""
        return float(self._aim[2])

    @property
    def camera_tilt(self) -> CameraTilt:
        """Tilt and roll of the camera beyond those of its joints, however small."""
        return CameraTilt(self.tilt_rad, self.roll_change_rad)

    def turn(self, tilt_rad: float, roll_rad: float) -> None:
        """Take the tilt to be so much larger, and the camera to lean so much more to its right."""
        if tilt_rad or roll_rad:
            aim = np.array([0.0, self._aim[1] + tilt_rad, self._aim[2] + roll_rad])
            aim[np.abs(aim) < TILTED_RAD] = 0.0
            self._tell_lean(float(aim[2]))
            self._aim = aim

    def levelled(self, frame: CameraFrame) -> CameraFrame:
        """Return an image with tilt and roll corrected, and the pan as measured."""
        return _turned(frame, self._aim * [0.0, 1.0, 1.0])

    def _tell_lean(self, roll_rad: float) -> None:
        """Log another lean than the present one."""
        if abs(roll_rad - self.roll_change_rad) > TILTED_RAD:
            if roll_rad:
                _LOG.warning('camera is rolled by %.1f deg %s', *degrees_aside(roll_rad))
            else:
                _LOG.warning('camera is rolled no more')

    def detect(
        self,
        frame: CameraFrame,
        prior: PoseEstimate,
        expected: npt.NDArray[np.intp],
        displaced: bool = True,
        tells: bool = True,
    ) -> DetectionResult:
        """
        Find landmarks of the map, as `detect_landmarks` does.

        Parameters
        ----------
        frame : CameraFrame
            Image with its joint angles.
        prior : PoseEstimate
            Expected pose of the base.
        expected : ndarray of int, shape (n,)
            Columns of the landmarks in the map.
        displaced : bool
            Whether a knock may be the reason if they are missing.
        tells : bool
            Whether the prior is sure enough to estimate the camera's direction.

        """
        knock, config = self._knock if displaced else 0.0, self._config
        result = self._search(frame, prior, expected, config, self._aim)
        if len(result.detections) <= _HARDLY_ANY * len(expected) and self._aim[0]:
            # What passed for a turn of the camera may have been an error of the heading.
            ahead = self._search(frame, prior, expected, config, self._aim * [0.0, 1.0, 1.0])
            result = max(ahead, result, key=lambda found: len(found.detections))
        asked = tells and self._knock and result.heights.may_tell_a_roll
        if asked and (camera_tilt := estimate_camera_tilt(result.heights)).is_roll:
            aim = self._aim + np.array([0.0, camera_tilt.tilt_rad, camera_tilt.roll_rad])
            again = self._search(frame, prior, expected, config, aim)
            roll = float(aim[2])
            if self._confirms_roll(result, again, expected) and self._agree(
                again, frame, prior, roll
            ):
                self._follow(again, frame, prior, roll)
                return again
        few = len(result.detections) <= _HARDLY_ANY * len(expected) or _many_beside(result)
        if not few or len(expected) < _LEAST or not knock:
            if tells and self._tells(result, expected):
                self._follow(result, frame, prior)
            return result
        wide = replace(prior, covariance=prior.covariance + np.diag([0.0, 0.0, knock**2]))
        height = np.hypot(config.vertical_sigma_px, knock * frame.camera.fy)
        tall = replace(config, vertical_sigma_px=min(50.0, float(height)))
        around = self._search(frame, wide, expected, tall, self._aim * [0.0, 1.0, 1.0])
        if len(around.detections) < _LEAST:
            return result
        # Mistaken matches are not found again in the narrow rows of a normal search.
        camera_tilt = estimate_camera_tilt(around.heights)
        for roll in (camera_tilt.roll_rad, 0.0) if camera_tilt.is_roll else (0.0,):
            leaning = self.roll_change_rad + roll
            aim, _ = self._seen_aim(around, frame, prior, leaning)
            if np.abs(aim - self._aim).max() * frame.camera.fx < LEAST_WINDOW_PX:
                # That little aside everything would have been found at once: this is no knock.
                continue
            again = self._search(frame, wide, expected, config, aim)
            right = self._tells(again, expected) and not _many_beside(again)
            if roll:
                right &= self._confirms_roll(result, again, expected)
                right &= self._agree(again, frame, prior, leaning)
            if right and len(again.detections) > len(result.detections):
                self._follow(again, frame, prior, leaning)
                return again
        return result

    def _confirms_roll(
        self, before: DetectionResult, result: DetectionResult, expected: npt.NDArray[np.intp]
    ) -> bool:
        """Whether a result with another roll is no worse than the one before."""
        # One or another of posters that were exchanged fits some roll.
        beside = _beside(before)
        fits = np.isin(beside, result.detections.ids).sum()
        return bool(
            (not beside or fits > _MOST * len(beside))
            and len(result.detections) >= len(before.detections)
            and self._tells(result, expected)
            and not estimate_camera_tilt(result.heights).is_roll
        )

    def _agree(
        self, found: DetectionResult, frame: CameraFrame, prior: PoseEstimate, roll: float
    ) -> bool:
        """
        Whether most bearings are off by one angle, as those of a camera that leans are.

        From a wrong place landmarks are aside by other angles when they are near than when far,
        and those on one side are higher.
        """
        (aside, _), away = self._off(found, frame, prior, roll)
        apart = np.abs(aside - median(aside.tolist())).tolist()
        reach_m = median(np.hypot(away[:, 0], away[:, 1]).tolist())
        return bool(median(apart) < _APART_RAD + _APART_SHARE * _sigma_m(prior) / reach_m)

    @staticmethod
    def _tells(result: DetectionResult, expected: npt.NDArray[np.intp]) -> bool:
        """Whether enough was found to estimate the camera's direction."""
        return len(result.detections) >= max(_LEAST, _MOST * len(expected))

    def _follow(
        self,
        result: DetectionResult,
        frame: CameraFrame,
        prior: PoseEstimate,
        knock_roll_rad: float | None = None,
    ) -> None:
        """Update the correction by an image, if there is one or the camera was displaced."""
        roll = self.roll_change_rad if knock_roll_rad is None else knock_roll_rad
        if (
            roll
            and (camera_tilt := estimate_camera_tilt(result.heights)).roll_sigma_rad < TILTED_RAD
        ):
            roll += _ROLL_SHARE * camera_tilt.roll_rad
        if abs(roll) < TILTED_RAD:
            roll = 0.0
        aim, away = self._seen_aim(result, frame, prior, roll)
        reach = np.hypot(away[:, 0], away[:, 1])
        # It is a knock if it is also more than the camera's height explains.
        unconfirmed_limit_rad = CAMERA_HEIGHT_SIGMA_M / median(reach.tolist())
        if _sigma_m(prior) * median((np.abs(away[:, 2]) / reach**2).tolist()) > TILTED_RAD:
            # The position is too uncertain: from nearer by, high landmarks appear higher.
            aim[1] = self._aim[1]
        tilted = abs(aim[1] - self._told_rad) > TILTED_RAD + unconfirmed_limit_rad
        if tilted:
            self._told_rad = aim[1]
            side = 'above' if self._mount.pan_sense * aim[1] > 0.0 else 'below'
            degrees = np.degrees(abs(aim[1]))
            _LOG.warning('camera looks %.1f deg %s where its joints say', degrees, side)
        self._tell_lean(float(aim[2]))
        if knock_roll_rad is not None or tilted or self._aim.any():
            self._aim = aim

    def _search(
        self,
        frame: CameraFrame,
        prior: PoseEstimate,
        expected: npt.NDArray[np.intp],
        config: DetectionConfig,
        aim: FloatArray,
    ) -> DetectionResult:
        """Search with the camera turned by `aim` (3,); bearings are those of the joints."""
        turned = _turned(frame, aim)
        result, self._blur = detect_blurred(
            turned, prior, self._map, self._mount, config, expected, self._blur
        )
        found = result.detections
        if aim[0]:
            found = replace(
                found, bearing_rad=wrap_rad(found.bearing_rad - self._mount.pan_sense * aim[0])
            )
        if aim[2]:
            # A roll is not known exactly: it moves what is high or low in the image aside.
            rotation, _ = self._mount.camera_pose_base(
                turned.pan_rad, turned.tilt_rad, turned.roll_rad
            )
            x, y, _ = (result.rays @ rotation.T).T
            by_x, by_y, _ = np.cross(result.rays @ rotation.T, rotation[:, 2]).T
            camera_tilt = estimate_camera_tilt(result.heights)
            sigma = min(
                float(np.hypot(camera_tilt.roll_rad, camera_tilt.roll_sigma_rad)), TILTED_RAD
            )
            across = sigma * (x * by_y - y * by_x) / (x**2 + y**2)
            found = replace(found, variance_rad2=found.variance_rad2 + across**2)
        return replace(result, detections=found)

    def _seen_aim(
        self, found: DetectionResult, frame: CameraFrame, prior: PoseEstimate, roll: float
    ) -> tuple[FloatArray, FloatArray]:
        """
        Return the correction for an image with a given roll, and positions from the camera.

        Returns
        -------
        aim : ndarray, shape (3,)
            Pan, tilt and roll, radians. Pan and tilt are medians over the landmarks found; the pan
            includes the error of the expected heading.
        expected : ndarray, shape (n, 3)
            Landmarks found, relative to the camera, in the axes of the map, metres.

        """
        off, expected = self._off(found, frame, prior, roll)
        pan, tilt = (self._mount.pan_sense * median(each) for each in off.tolist())
        return np.array([pan, tilt, roll]), expected

    def _off(
        self, found: DetectionResult, frame: CameraFrame, prior: PoseEstimate, roll: float
    ) -> tuple[FloatArray, FloatArray]:
        """Azimuth and elevation (2, n) expected minus seen, and `expected` of `_seen_aim`."""
        rotation, center = self._mount.camera_pose_map(
            prior.pose, frame.pan_rad, frame.tilt_rad, frame.roll_rad + roll
        )
        expected = self._map.positions[self._map.indices(found.detections.ids)] - center
        seen = found.rays @ rotation.T
        return wrap_rad(_angles(expected) - _angles(seen)), expected


def degrees_aside(roll_rad: float) -> tuple[float, str]:
    """Return the roll of a camera in degrees, and its side in words."""
    return float(np.degrees(abs(roll_rad))), 'to the right' if roll_rad > 0.0 else 'to the left'


def _sigma_m(prior: PoseEstimate) -> float:
    """Sigma of a position, root of the trace."""
    return float(np.sqrt(np.trace(prior.covariance[:2, :2])))


def _turned(frame: CameraFrame, aim: FloatArray) -> CameraFrame:
    if not aim.any():
        return frame
    pan, tilt, roll = aim.tolist()
    return replace(
        frame,
        pan_rad=frame.pan_rad + pan,
        tilt_rad=frame.tilt_rad + tilt,
        roll_rad=frame.roll_rad + roll,
    )


def _beside(result: DetectionResult) -> list[int]:
    """Ids of the landmarks whose matches were refused for their height."""
    return [k for k, refusal in result.refused.items() if refusal.reason in _BESIDE]


def _many_beside(result: DetectionResult) -> bool:
    """Whether many matches were refused for their height, as by an unknown tilt or roll."""
    looked = len(result.detections) + len(result.refused)
    return len(_beside(result)) >= max(_LEAST - 1, _HARDLY_ANY * looked)


def _angles(rays: FloatArray) -> FloatArray:
    """Azimuth and elevation (2, n) of rays (n, 3)."""
    x, y, z = rays.T
    return np.array([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
