"""Global localization from a stream of images and odometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
import math
from typing import NamedTuple

import numpy as np

from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.image_stages import ImageStagesConfig
from landmark_nav.localization.joint_delay import DELAY_BOUND_S
from landmark_nav.localization.odometry.noise import (
    jitter_variances,
    left_variance,
    motion_variances,
    OdometryNoiseConfig,
)
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.localization.relocalization.candidate_detections import (
    CandidateDetections,
    find_candidate_detections,
)
from landmark_nav.localization.relocalization.search import (
    locate,
    nothing_recognised,
    RelocalizationConfig,
)
from landmark_nav.localization.relocalization.verification import CarriedFrames, PlaceVerifier
from landmark_nav.localization.triangulation.model import axis_from_base, base_from_axis
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
    RefusalCode,
)

# An image is new if its direction differs by this share of half the field of view, horizontally or
# vertically, or its position by this distance.
_NEW_VIEW = 0.9
_NEW_PLACE_M = 0.6


def view_direction(frame: CameraFrame, mount: PanTiltMount) -> FloatArray:
    """Azimuth and elevation (2,) of the optical axis in the base frame, rad."""
    turn, _ = mount.camera_pose_base(frame.pan_rad, frame.tilt_rad)
    x, y, z = turn[:, 2].tolist()
    return np.array([math.atan2(y, x), math.atan2(z, math.hypot(x, y))])


def shows_new(
    frame: CameraFrame, direction: FloatArray, directions: FloatArray, poses: FloatArray
) -> bool:
    """
    Whether an image shows more of the room than earlier ones.

    Parameters
    ----------
    direction : ndarray, shape (2,)
        `view_direction` of the image.
    directions : ndarray, shape (n, 2)
        `view_direction` of earlier images, each in its own base frame.
    poses : ndarray, shape (n, 3)
        Poses of the base at the earlier images, in the base frame of this one.
    """
    off = np.reshape(directions, (-1, 2)) - direction
    off[:, 0] = wrap_rad(off[:, 0] + poses[:, 2])
    half = frame.camera.half_fov_rad * np.array([1.0, frame.camera.height / frame.camera.width])
    same = np.all(np.abs(off) < _NEW_VIEW * half, axis=1)
    near = np.hypot(*poses[:, :2].T) < _NEW_PLACE_M
    return not np.any(same & near)


# An image is dropped once the drift of odometry since then exceeds these sigmas, m, m and rad.
_MAX_DRIFT = np.array([0.1, 0.1, 0.1])
# Most images kept.
_MAX_FRAMES = 30
# Odometry older by this means that the clock was set back.
_CLOCK_STEP_NS = 2 * 10**9
# With this number of images and no place, a displaced camera is searched too.
_TILT_AFTER = 2
# Sigma of way and turn of uncalibrated wheels, relative.
_SLIP = 0.04


class _Keyframe(NamedTuple):
    """An image with its viewing direction and candidate detections."""

    frame: CameraFrame
    direction: FloatArray
    detections: CandidateDetections
    # Candidates for uncertain tilt and roll of the camera.
    tilted: CandidateDetections | None = None


class Unseen:
    """Whether images have shown no landmark for `after_s` or longer."""

    def __init__(self, after_s: float) -> None:
        self._after_ns = round(1e9 * after_s)
        self._since_ns: int | None = None
        self.lasts = False

    def note(self, stamp_ns: int, found: int) -> None:
        """Count the landmarks found in an image."""
        if found or self._since_ns is None or stamp_ns < self._since_ns:
            self._since_ns = stamp_ns
        self.lasts = not found and stamp_ns - self._since_ns >= self._after_ns

    def restart(self) -> None:
        """Restart with the next image."""
        self._since_ns, self.lasts = None, False


class Relocalizer:
    """
    Collects views of the room until only one place explains them.

    Parameters
    ----------
    odometry : OdometryNoiseConfig, optional
        Noise of the odometry.
    stages : ImageStagesConfig, optional
        Parameters of the detection that verifies a hypothesis.
    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        mount: PanTiltMount,
        config: RelocalizationConfig | None = None,
        odometry: OdometryNoiseConfig | None = None,
        stages: ImageStagesConfig | None = None,
    ) -> None:
        self._map, self._mount = landmark_map.distinct, mount
        self._config = config or RelocalizationConfig()
        self._odometry = odometry or OdometryNoiseConfig()
        self._verifier = PlaceVerifier(self._map, mount, stages or ImageStagesConfig())
        self._track = OdometryTrack(self._odometry)
        self._kept: list[_Keyframe] = []
        self._outcome = Refusal('nothing seen yet', 'no image came')
        self.landmark_ids = np.empty(0, dtype=np.int64)
        self.in_time: PoseEstimate

    def add_odometry(self, sample: OdometrySample) -> None:
        """Add a sample of odometry."""
        # By the clock of the images.
        late_ns = round(1e9 * self._mount.image_delay_s)
        sample = replace(sample, stamp_ns=sample.stamp_ns + late_ns)
        # The filter reports faults of the odometry.
        self._track.add(sample)
        known = self._track.stamps_ns
        if known is not None and known[1] - sample.stamp_ns > _CLOCK_STEP_NS:
            # The clock was set back: images from before are of no use.
            self._kept, self._track = [], OdometryTrack(self._odometry)
            self._track.add(sample)
        # An image may still come that is older than the odometry.
        oldest_ns = sample.stamp_ns - _CLOCK_STEP_NS
        self._track.trim(min([oldest_ns, *(kept.frame.stamp_ns for kept in self._kept[:1])]))

    def add_frame(self, frame: CameraFrame) -> PoseEstimate | Refusal:
        """
        Add an image.

        Parameters
        ----------
        frame : CameraFrame
            Image with its joint angles.

        Returns
        -------
        PoseEstimate or Refusal
            Pose of the base at the image's stamp, or why there is none yet. An image that shows
            nothing new is not searched: the last reason is returned.
        """
        if not np.isfinite([frame.pan_rad, frame.tilt_rad]).all():
            return self._outcome
        direction = view_direction(frame, self._mount)
        poses, variances = self._carried(frame.stamp_ns)
        # Images from too far back, or from before the clock was set back, are dropped.
        stamps_ns = np.array([keyframe.frame.stamp_ns for keyframe in self._kept], dtype=np.int64)
        recent_enough = (stamps_ns < frame.stamp_ns) & (variances < _MAX_DRIFT**2).all(axis=1)
        self._kept = list(compress(self._kept, recent_enough))
        poses, variances = poses[recent_enough], variances[recent_enough]
        looked = np.array([keyframe.direction for keyframe in self._kept])
        repeats = self._kept and np.array_equal(frame.image, self._kept[-1].frame.image)
        if repeats or not shows_new(frame, direction, looked, poses):
            return self._outcome
        recent = slice(-_MAX_FRAMES, None)
        carried = CarriedFrames(
            frame.stamp_ns,
            [*(keyframe.frame for keyframe in self._kept), frame][recent],
            np.vstack([poses, np.zeros(3)])[recent],
            np.vstack([variances, np.zeros(3)])[recent],
        )
        detections = find_candidate_detections(carried.frames[-1], self._map, self._mount)
        if not len(detections):
            # Kept, it would keep later images of this direction from being searched.
            self._outcome = nothing_recognised('no landmark looks like anything in the image')
            return self._outcome
        self._kept = [*self._kept, _Keyframe(frame, direction, detections)][recent]
        seen = [keyframe.detections for keyframe in self._kept]
        outcome = locate(carried, seen, self._verifier, self._config)
        tilt_sigma = self._config.tilt_sigma_rad
        failed = isinstance(outcome, Refusal) and outcome.code is RefusalCode.UNRECOGNISED
        if failed and tilt_sigma and len(self._kept) >= _TILT_AFTER:
            seen = self._tilted(carried.frames, tilt_sigma)
            verifier = replace(self._verifier, tilt_sigma_rad=tilt_sigma)
            tilted = locate(carried, seen, verifier, self._config)
            outcome = outcome if isinstance(tilted, Refusal) else tilted
        if isinstance(outcome, Refusal):
            self._outcome = outcome
            return outcome
        # If joint states are late, all images agree on a wrong heading.
        delay_variances = np.square(
            [DELAY_BOUND_S * kept.frame.pan_rate_rad_s for kept in self._kept]
        )
        others = max(delay_variances.mean() - delay_variances[-1], 0.0)
        self.landmark_ids, self.in_time = outcome.ids, self._turned(outcome.estimate, others)
        return self._turned(self.in_time, delay_variances[-1])

    def _tilted(
        self, frames: Sequence[CameraFrame], tilt_sigma_rad: float
    ) -> list[CandidateDetections]:
        """Candidate detections in the kept images for uncertain tilt and roll of the camera."""
        for k, (keyframe, frame) in enumerate(zip(self._kept, frames, strict=True)):
            if keyframe.tilted is None:
                seen = find_candidate_detections(
                    frame, self._map, self._mount, tilt_sigma_rad=tilt_sigma_rad
                )
                self._kept[k] = keyframe._replace(tilted=seen)
        return [keyframe.tilted for keyframe in self._kept if keyframe.tilted is not None]

    def _turned(self, found: PoseEstimate, variance: float) -> PoseEstimate:
        """Return a place with an additional variance of the rotation about the pan axis."""
        axis = axis_from_base(found, self._mount)
        covariance = axis.covariance + np.diag([0.0, 0.0, variance])
        return base_from_axis(replace(axis, covariance=covariance), self._mount)

    def _carried(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Poses (n, 3) of the base at the kept images, relative to now, and variances."""
        increments, variances = np.zeros((2, len(self._kept), 3))
        for k, keyframe in enumerate(self._kept):
            motion = self._track.motion(keyframe.frame.stamp_ns, stamp_ns)
            increments[k] = motion.increment
            way, turn = np.hypot(*motion.increment[:2]), abs(motion.increment[2])
            sensed = motion_variances(motion, self._odometry)
            sensed[1] = left_variance(motion, self._odometry)
            # Wheels may be uncalibrated.
            share = _SLIP * np.array([way, way, turn])
            variances[k] = sensed + jitter_variances(motion) + share**2
        return se2.inverse(increments), variances
