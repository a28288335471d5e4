"""Finding the robot's place from images and odometry as they come in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.late_joints import DELAY_BOUND_S
from landmark_nav.localization.looking import LookingConfig
from landmark_nav.localization.odometry.noise import (
    jitter_variances,
    Motion,
    motion_variances,
    OdometryNoiseConfig,
)
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.localization.relocalization.candidate_detections import (
    CandidateDetections,
    find_candidate_detections,
)
from landmark_nav.localization.relocalization.config import RelocalizationConfig
from landmark_nav.localization.relocalization.search import locate
from landmark_nav.localization.relocalization.verification import CarriedFrames
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

# An image adds something new if it looks this share of half the field of view elsewhere, aside
# or up, or from this far away.
_NEW_VIEW = 0.9
_NEW_PLACE_M = 0.6


def view_direction(frame: CameraFrame, mount: PanTiltMount) -> FloatArray:
    """Azimuth and elevation (2,) in the base frame that an image looks along, radians."""
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
        Its `view_direction`.
    directions : ndarray, shape (n, 2)
        Those of the earlier images, each in its own base frame.
    poses : ndarray, shape (n, 3)
        Poses of the base at the earlier images, in the base frame of this one.
    """
    off = np.reshape(directions, (-1, 2)) - direction
    off[:, 0] = wrap_rad(off[:, 0] + poses[:, 2])
    half = frame.camera.half_fov_rad * np.array([1.0, frame.camera.height / frame.camera.width])
    same = np.all(np.abs(off) < _NEW_VIEW * half, axis=1)
    near = np.hypot(*poses[:, :2].T) < _NEW_PLACE_M
    return not np.any(same & near)


# An image counts until odometry since then is more uncertain than this.
_MAX_DRIFT_M = 0.1
_MAX_DRIFT_RAD = 0.1
# So many images are kept at most.
_MAX_FRAMES = 30
# Odometry older by this is not late: the clock was set back.
_CLOCK_STEP_NS = 2 * 10**9
# With so many images without a place the camera may have been displaced up, down, or aside.
_VAIN = 2
# Share of way and turn that wheels may be wrong by.
_SLIP = 0.04


class _Keyframe(NamedTuple):
    """An image as it came, with its viewing direction and what may be seen in it."""

    frame: CameraFrame
    direction: FloatArray
    detections: CandidateDetections
    # Those of a camera whose tilt and roll may be off.
    tilted: CandidateDetections | None = None


class Unseen:
    """Whether images have shown no landmark for `after_s` or longer."""

    def __init__(self, after_s: float) -> None:
        self._after_ns = round(1e9 * after_s)
        self._since_ns: int | None = None
        self.lasts = False

    def note(self, stamp_ns: int, found: int) -> None:
        """Take note of how many landmarks an image showed."""
        if found or self._since_ns is None or stamp_ns < self._since_ns:
            self._since_ns = stamp_ns
        self.lasts = not found and stamp_ns - self._since_ns >= self._after_ns

    def restart(self) -> None:
        """Begin anew with the next image."""
        self._since_ns, self.lasts = None, False


class Relocalizer:
    """
    Gathers views of the room until they fit one place only.

    Parameters
    ----------
    odometry : OdometryNoiseConfig, optional
        How far the odometry is to be trusted.
    looking : LookingConfig, optional
        How landmarks are looked for where they are to be expected.
    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        mount: PanTiltMount,
        config: RelocalizationConfig | None = None,
        odometry: OdometryNoiseConfig | None = None,
        looking: LookingConfig | None = None,
    ) -> None:
        self._map, self._mount = landmark_map, mount
        self._config = config or RelocalizationConfig()
        self._odometry = odometry or OdometryNoiseConfig()
        self._looking = looking or LookingConfig()
        self._track = OdometryTrack(self._odometry)
        self._kept: list[_Keyframe] = []
        self._outcome = Refusal('nothing seen yet', 'no image came')
        self._landmark_ids = np.empty(0, dtype=np.int64)
        self._in_time: PoseEstimate | None = None

    def add_odometry(self, sample: OdometrySample) -> None:
        """Move on."""
        # The filter reports what is wrong with it.
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
        Look at an image.

        Parameters
        ----------
        frame : CameraFrame
            Image with its joint angles.

        Returns
        -------
        PoseEstimate or Refusal
            Pose of the base at the image's stamp, or why it is not known yet. An image that
            shows nothing new is not searched: the last reason is repeated.
        """
        if not np.isfinite([frame.pan_rad, frame.tilt_rad]).all():
            return self._outcome
        direction = view_direction(frame, self._mount)
        poses, variances = self._carried(frame.stamp_ns)
        # Images from too long a way ago, or from a clock that was set back, are dropped.
        sure = [
            keyframe.frame.stamp_ns < frame.stamp_ns
            and max(variance[:2]) < _MAX_DRIFT_M**2
            and variance[2] < _MAX_DRIFT_RAD**2
            for keyframe, variance in zip(self._kept, variances, strict=True)
        ]
        self._kept = [keyframe for keyframe, keep in zip(self._kept, sure, strict=True) if keep]
        poses, variances = poses[sure], variances[sure]
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
        self._kept = [*self._kept, _Keyframe(frame, direction, detections)][recent]
        seen = [keyframe.detections for keyframe in self._kept]
        outcome = locate(carried, seen, self._map, self._mount, self._config, self._looking)
        tilt_sigma = self._config.tilt_sigma_rad
        vain = isinstance(outcome, Refusal) and outcome.code is RefusalCode.UNRECOGNISED
        if vain and tilt_sigma and len(self._kept) >= _VAIN:
            seen = self._tilted(carried.frames, tilt_sigma)
            tilted = locate(
                carried, seen, self._map, self._mount, self._config, self._looking, tilt_sigma
            )
            outcome = outcome if isinstance(tilted, Refusal) else tilted
        if isinstance(outcome, Refusal):
            self._outcome = outcome
            return outcome
        # If joint states are late, all images agree on a heading that is wrong.
        delay_variances = np.square(
            [DELAY_BOUND_S * kept.frame.pan_rate_rad_s for kept in self._kept]
        )
        others = max(delay_variances.mean() - delay_variances[-1], 0.0)
        self._landmark_ids, self._in_time = outcome.ids, self._turned(outcome.estimate, others)
        return self._turned(self._in_time, delay_variances[-1])

    @property
    def in_time(self) -> PoseEstimate:
        """The last place, if the joint states of its last image are in time."""
        assert self._in_time is not None, 'no place was found'
        return self._in_time

    @property
    def landmark_ids(self) -> npt.NDArray[np.int64]:
        """Ids of the landmarks from which the last place was found."""
        return self._landmark_ids

    def _tilted(
        self, frames: Sequence[CameraFrame], tilt_sigma_rad: float
    ) -> list[CandidateDetections]:
        """Detections in the kept images of a camera whose tilt and roll may be off."""
        for k, (keyframe, frame) in enumerate(zip(self._kept, frames, strict=True)):
            if keyframe.tilted is None:
                seen = find_candidate_detections(
                    frame, self._map, self._mount, tilt_sigma_rad=tilt_sigma_rad
                )
                self._kept[k] = keyframe._replace(tilted=seen)
        return [keyframe.tilted for keyframe in self._kept if keyframe.tilted is not None]

    def _turned(self, found: PoseEstimate, variance: float) -> PoseEstimate:
        """Return a place that may have been turned about the pan axis."""
        axis = axis_from_base(found, self._mount)
        covariance = axis.covariance + np.diag([0.0, 0.0, variance])
        return base_from_axis(replace(axis, covariance=covariance), self._mount)

    def _carried(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Poses (n, 3) of the base at the kept images, relative to now, and their variances."""
        motions = [self._track.motion(kept.frame.stamp_ns, stamp_ns) for kept in self._kept]
        poses = se2.inverse(np.array([m.increment for m in motions]).reshape(-1, 3))
        return poses, np.array([self._variances(motion) for motion in motions]).reshape(-1, 3)

    def _variances(self, motion: Motion) -> FloatArray:
        """Variances (3,) of a motion by wheels that are not calibrated yet."""
        way, turn = np.hypot(*motion.increment[:2]), abs(motion.increment[2])
        share = _SLIP * np.array([way, way, turn])
        sensed = motion_variances(motion, self._odometry) + jitter_variances(motion)
        return np.asarray(sensed + share**2)
