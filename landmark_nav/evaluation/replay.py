"""Replay of a recorded drive through the localization pipeline."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
import time

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IntArray
from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.metrics import pose_errors, PoseTrack
from landmark_nav.geometry import se2
from landmark_nav.localization.estimator.integrity import Status
from landmark_nav.localization.localizer import LocalizationConfig, LocalizationUpdate, Localizer
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.storage.bags import SensorEvent
from landmark_nav.types import (
    CameraFrame,
    Detections,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)

# If stamps of odometry go back by more, the clock was set back.
_STEP_NS = 500_000_000
# Time inserted between the last odometry before such a step and the first one after it.
_GAP_NS = 100_000_000
# Least resolution of images, as a share of that of the map.
_RESOLUTION = 0.75


class UnknownPlaceError(LandmarkNavError):
    """The pose was never found by global localization."""


def shifts_by_odometry(
    stamps_ns: npt.ArrayLike, after: npt.ArrayLike, odometry_ns: npt.ArrayLike
) -> IntArray:
    """
    Shifts [ns] of stamps (m,) that make time monotonic although the clock was set back.

    `after` (m,) are indices of the last odometry that arrived before each, -1 if there is none;
    `odometry_ns` (n,) are stamps in the order of arrival. Shifts are 0 if no clock was set back.
    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    clock = np.asarray(odometry_ns, dtype=np.int64)
    if not len(clock):
        return np.zeros_like(stamps)
    back = np.maximum(-np.diff(clock, prepend=clock[0]), 0)
    back[back < _STEP_NS] = 0
    shift = np.cumsum(back + _GAP_NS * (back > 0))
    last = np.maximum(np.asarray(after, dtype=np.intp), 0)
    following = np.minimum(last + 1, len(clock) - 1)
    stepped = np.maximum.accumulate(np.where(back > 0, np.arange(len(clock)), 0))[last]
    ahead = stamps - clock[last]
    # The streams arrive in any order: some messages have stamps of the new clock before the
    # odometry has, others have stamps of the old one after it.
    early = -2 * ahead > np.where(back[following] > 0, back[following], np.inf)
    late = 2 * ahead > np.where(stepped > 0, back[stepped], np.inf)
    return shift[np.where(early, following, np.where(late, stepped - 1, last))]


@dataclass(frozen=True, eq=False)
class RunErrors:
    """Errors (n, 3) at the images against the truth; NaN if one of both is unknown."""

    fused: FloatArray
    triangulation: FloatArray
    odometry: FloatArray


@dataclass(frozen=True, eq=False)
class Replay:
    """
    The results of a run; stamps are continuous even if the clock was set back.

    The `start` is given or found, in the last of the `searched` images. `seconds` is the computing
    time of the whole run, with reading and decoding, `update_seconds` that of each update.
    `odometry` is dead reckoning from the start; `truth` may be empty. Noise of the odometry,
    factor on the given sigmas of detections, and calibration are as learned by the end; there is
    no calibration for a recording of the nodes. `samples` are the measured odometry, sorted by
    time. `map_contradictions` are those of `Fusion` in the end.
    """

    start: PoseEstimate
    searched: tuple[int, ...]
    updates: tuple[LocalizationUpdate, ...]
    update_seconds: FloatArray
    odometry: PoseTrack
    truth: PoseTrack
    seconds: float
    odometry_noise: OdometryNoiseConfig = field(default_factory=OdometryNoiseConfig)
    detection_sigma_factor: float = 1.0
    samples: tuple[OdometrySample, ...] = ()
    calibration: Calibration | None = None
    map_contradictions: tuple[str, ...] = ()

    @property
    def begin_ns(self) -> int:
        """Stamp of the first image or odometry."""
        first = (*self.searched, *(update.stamp_ns for update in self.updates))[0]
        return min(first, int(self.odometry.stamps_ns[0]))

    @property
    def stamps_ns(self) -> npt.NDArray[np.int64]:
        """Stamps of the images, (n,)."""
        return np.array([update.stamp_ns for update in self.updates], dtype=np.int64)

    @property
    def fused(self) -> FloatArray:
        """Fused poses, (n, 3)."""
        return np.array([update.fused.pose for update in self.updates]).reshape(-1, 3)

    @property
    def fused_covariances(self) -> FloatArray:
        """Covariances of the fused poses, (n, 3, 3)."""
        return np.array([update.fused.covariance for update in self.updates]).reshape(-1, 3, 3)

    def track(self, config: OdometryNoiseConfig) -> OdometryTrack:
        """All measured odometry, with the motion between any two times."""
        track = OdometryTrack(config)
        for sample in self.samples:
            track.add(sample)
        return track

    @property
    def fixes(self) -> FloatArray:
        """Triangulated poses that passed the gates, (n, 3); NaN for images without a fix."""
        none = np.full(3, np.nan)
        fixes = [update.observation.fix for update in self.updates]
        poses = [fix.pose if isinstance(fix, PoseEstimate) else none for fix in fixes]
        return np.array(poses).reshape(-1, 3)

    @cached_property
    def errors(self) -> RunErrors:
        """Errors of the fused, the triangulated and the dead reckoned poses."""
        truth, odometry = self.truth.at(self.stamps_ns), self.odometry.at(self.stamps_ns)
        return RunErrors(*(pose_errors(k, truth) for k in (self.fused, self.fixes, odometry)))

    @property
    def lost(self) -> npt.NDArray[np.bool_]:
        """Mask (n,) of the images at which the fused state was lost."""
        return np.array([update.status == 'lost' for update in self.updates], dtype=np.bool_)

    @property
    def tracking(self) -> npt.NDArray[np.bool_]:
        """Mask (n,) of the images at which the fused state was OK."""
        return np.array(
            [update.status == Status.OK.value for update in self.updates], dtype=np.bool_
        )


def replay(
    events: Iterable[SensorEvent],
    landmark_map: LandmarkMap,
    calibration: Calibration,
    config: LocalizationConfig,
    start_pose: FloatArray | None = None,
    start_covariance: FloatArray | None = None,
) -> Replay:
    """
    Localize along a recorded drive, from measurements in the order of arrival.

    Ground truth is used for metrics only. `start_pose` of the base in map, with its covariance, is
    at the first image or odometry; by default it is found by global localization. `calibration` is
    the prior of mount, lens and clocks.

    Raises `LandmarkNavError`: there is no image or no odometry, all stamps are equal, or the pose
    was never found (`UnknownPlaceError`).
    """
    localizer = Localizer(landmark_map, calibration, config)
    start: PoseEstimate | None = None
    searched: list[int] = []
    refusal = Refusal('nothing seen')
    updates: list[LocalizationUpdate] = []
    took: list[float] = []
    samples: list[OdometrySample] = []
    truth: list[tuple[int, FloatArray]] = []
    # Index of the last odometry before each image and each ground truth.
    looked_after: list[int] = []
    truth_after: list[int] = []
    focal_px = np.inf
    begin = time.perf_counter()
    for event in events:
        if isinstance(event, PoseEstimate):
            truth.append((event.stamp_ns, event.pose))
            truth_after.append(len(samples) - 1)
            continue
        if start is None and start_pose is not None and start_covariance is not None:
            start = PoseEstimate(event.stamp_ns, start_pose, start_covariance)
            localizer.initialize(start)
        if isinstance(event, OdometrySample):
            samples.append(event)
            localizer.add_odometry(event)
        elif isinstance(event, CameraFrame | Detections):
            looked_after.append(len(samples) - 1)
            before = time.perf_counter()
            if isinstance(event, CameraFrame):
                focal_px = event.camera.fy
                update = localizer.add_frame(event)
            else:
                update = localizer.add_detections(event)
            if isinstance(update, LocalizationUpdate):
                took.append(time.perf_counter() - before)
                updates.append(update)
                continue
            searched.append(event.stamp_ns)
            if isinstance(update, PoseEstimate):
                start = update
            else:
                refusal = update
    if not samples or not (updates or searched):
        raise LandmarkNavError('the drive holds no image or no odometry: nothing to evaluate')
    if start is None:
        why = str(refusal)
        if (share := focal_px / landmark_map.focal_px) < _RESOLUTION:
            of_map = f'{100.0 * share:.0f} % of the pixels per degree of the map'
            why = f'they have {of_map}, {100.0 * _RESOLUTION:.0f} % are needed'
        raise UnknownPlaceError(
            f'the place was not found in {len(searched)} images ({why}): is the map of this room?'
        )
    if not updates:
        raise LandmarkNavError('the place was found in the last image: nothing to evaluate')
    if len(updates) > 1 and len({update.stamp_ns for update in updates}) == 1:
        raise LandmarkNavError(
            f'all {len(updates)} images are of one moment, {1e-9 * updates[0].stamp_ns:.3f} s: '
            'their publisher must stamp them (header.stamp)'
        )
    stamps_ns = [sample.stamp_ns for sample in samples]
    looked_ns = [*searched, *(update.stamp_ns for update in updates)]
    shifts = shifts_by_odometry(looked_ns, looked_after, stamps_ns).tolist()
    searched = [stamp + shift for stamp, shift in zip(searched, shifts, strict=False)]
    if searched:
        start = replace(start, stamp_ns=searched[-1])
    for k, shift in enumerate(shifts[len(searched) :]):
        stamp, seen = updates[k].stamp_ns + shift, updates[k].observation
        detections = replace(seen.detections, stamp_ns=stamp)
        seen = replace(seen, detections=detections)
        updates[k] = replace(updates[k], stamp_ns=stamp, observation=seen)
    moved = shifts_by_odometry(stamps_ns, range(len(samples)), stamps_ns).tolist()
    pairs = zip(samples, moved, strict=True)
    samples = [replace(sample, stamp_ns=sample.stamp_ns + later) for sample, later in pairs]
    samples.sort(key=lambda sample: sample.stamp_ns)
    known = shifts_by_odometry([s for s, _ in truth], truth_after, stamps_ns).tolist()
    track = PoseTrack.of((sample.stamp_ns, sample.pose_odom_base) for sample in samples)
    # Dead reckoning passes through the start.
    first = max(start.stamp_ns, int(track.stamps_ns[0]))
    increments = se2.relative(track.at([first]), track.poses)
    return Replay(
        start,
        tuple(searched),
        tuple(updates),
        np.array(took),
        PoseTrack(track.stamps_ns, se2.compose(start.pose, increments)),
        PoseTrack.of((s + later, pose) for (s, pose), later in zip(truth, known, strict=True)),
        time.perf_counter() - begin,
        localizer.fusion.odometry_noise,
        localizer.fusion.detection_sigma_factor,
        tuple(samples),
        localizer.fusion.calibration,
        tuple(localizer.fusion.map_contradictions),
    )
