"""Calibration of a robot from recorded drives: estimate, covariance and residuals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.se2 import relative
from landmark_nav.localization.estimator import ImagePoints, JointFilter
from landmark_nav.localization.estimator.timeline import Timeline
from landmark_nav.localization.localizer import (
    LocalizationConfig,
    LocalizationUpdate,
    Localizer,
)
from landmark_nav.localization.odometry.noise import left_variance, Motion
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.storage.bags import SensorEvent
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)

# Tilt of the map relative to the floor, rad, if papers are misplaced by a millimetre: least sigma
# of roll and pitch of the pan axis by a drive.
_LEVEL_RAD = 5e-4
# Greatest share of the images in which localization is lost.
_MOST_LOST = 0.5
# Correlation beyond which two quantities are not separately observable.
_TRADES_OFF = 0.9
# Sigmas beyond which the estimate contradicts a value that was given as exact.
_CONTRADICTION = 5.0
# Motion -> quantities that it makes observable.
_SHOWN_BY = {
    'a turn on the spot in view of mapped landmarks, to both sides': ('axis_x', 'axis_y'),
    'several straight metres': ('axis_yaw',),
    'a sweep with papers in view, or landmarks near by and far away': (
        'axis_z',
        'center_z',
        'axis_roll',
        'axis_pitch',
    ),
    'a sweep near textured walls': ('center_x', 'center_y'),
    'a sweep over a full turn': ('pan_scale', 'focal_scale', 'camera_roll', 'camera_tilt'),
    'images during pan motion, slow and fast, in both directions': ('joint_delay',),
    'the same landmarks at the left and at the right border of the image': ('principal_point',),
}


@dataclass(frozen=True, eq=False)
class Residuals:
    """
    Measured minus predicted points of landmarks in the images of a drive.

    `seconds` (m,) are times since the start of the drive, `points_px` (m, 2) residuals to the
    right and down, `weights` (m,) robust weights, near 0 for outliers.
    """

    seconds: FloatArray
    points_px: FloatArray
    weights: FloatArray

    @property
    def rms_px(self) -> FloatArray:
        """Weighted root mean square to the right and down, (2,); NaN if there are no points."""
        total = self.weights.sum()
        if not total:
            return np.full(2, np.nan)
        return np.asarray(np.sqrt(self.weights @ self.points_px**2 / total))


@dataclass(frozen=True, eq=False)
class CalibrationDrive:
    """
    A drive through the estimator.

    Parameters
    ----------
    start : PoseEstimate
        Pose at the first image in which landmarks were found.
    calibration : Calibration
        Estimate at the end.
    images, lost : int
        Number of images since the start, and of those in which localization was lost.
    landmark_map : LandmarkMap
        Map of the drive.
    slip_bound_rad : float
        Sigma of the direction of travel by the learned noise of the wheels, mostly side slip in
        turns. It is the least sigma of pan zero.
    """

    start: PoseEstimate
    calibration: Calibration
    images: int
    lost: int
    landmark_map: LandmarkMap
    slip_bound_rad: float
    _measured: tuple[OdometrySample | tuple[ImagePoints, float], ...]
    _config: LocalizationConfig

    def again(self, calibration: Calibration) -> tuple[Calibration, Residuals]:
        """Return estimate and residuals by the same detections with another prior."""
        config = self._config
        joint = JointFilter(
            self.landmark_map, calibration, self.start, config.estimator, config.odometry
        )
        line = Timeline(joint, OdometryTrack(config.odometry), config.estimator.history_s)
        seconds, points, weights = [], [], []
        for measured in self._measured:
            if isinstance(measured, OdometrySample):
                line.add_odometry(measured)
                continue
            seen, focal_px = measured
            update = line.add_image(seen)
            if isinstance(update, Refusal) or not len(update.columns):
                continue
            since_s = 1e-9 * (update.stamp_ns - self.start.stamp_ns)
            seconds.append(np.full(len(update.columns), since_s))
            points.append(focal_px * update.residual)
            weights.append(update.weight)
        none = [np.empty(0)]
        return line.filter.calibration, Residuals(
            np.concatenate(seconds or none),
            np.concatenate(points or [np.empty((0, 2))]),
            np.concatenate(weights or none),
        )


def calibrate_by_drive(
    events: Iterable[SensorEvent],
    landmark_map: LandmarkMap,
    prior: Calibration,
    config: LocalizationConfig,
) -> CalibrationDrive:
    """
    Estimate the calibration over a drive.

    Raises `LandmarkNavError`: no image or odometry, no pose found, or a drive that does not fit
    the map.

    Parameters
    ----------
    events : iterable of SensorEvent
        Measurements; ground truth is not used, and the initial pose is found by global
        localization.
    """
    localizer = Localizer(landmark_map, prior, config)
    measured: list[OdometrySample | tuple[ImagePoints, float]] = []
    begin: PoseEstimate | None = None
    images = lost = searched = 0
    moved = False
    refusal = Refusal('no image')
    for event in events:
        if isinstance(event, OdometrySample):
            localizer.add_odometry(event)
            measured.append(event)
            moved = True
        elif isinstance(event, CameraFrame):
            update = localizer.add_frame(event)
            if not isinstance(update, LocalizationUpdate):
                searched += 1
                refusal = update if isinstance(update, Refusal) else refusal
                continue
            images += 1
            lost += update.status == 'lost'
            if begin is None:
                begin = update.fused
                # Odometry before the initial pose cannot be used.
                odometry = [m for m in measured if isinstance(m, OdometrySample)]
                measured = list(odometry[-1:])
            assert update.points is not None, 'it is of an image'
            points = replace(update.points, near=None)
            measured.append((points, event.camera.fx))
    if not moved or not (images or searched):
        raise LandmarkNavError('the drive holds no image or no odometry: nothing to calibrate by')
    if begin is None:
        raise LandmarkNavError(
            f'the pose was not found in {searched} images ({refusal}): is the map of this room?'
        )
    if lost > _MOST_LOST * images:
        raise LandmarkNavError(
            f'localization is lost in {lost} of {images} images: is the map of this room, and '
            'camera_info of this camera?'
        )
    found = localizer.calibration
    lean = [NAMES.index(name) for name in ('axis_roll', 'axis_pitch')]
    level = np.zeros_like(found.covariance)
    # Exact quantities remain exact.
    level[lean, lean] = np.where(prior.sigmas[lean] > 0.0, _LEVEL_RAD**2, 0.0)
    found = replace(found, covariance=found.covariance + level)
    return CalibrationDrive(
        begin, found, images, lost, landmark_map, _direction_bound(measured, localizer),
        tuple(measured), config,
    )  # fmt: skip


def _direction_bound(
    measured: Sequence[OdometrySample | tuple[ImagePoints, float]], localizer: Localizer
) -> float:
    """Sigma of the mean direction of travel, rad, with each step weighted by its information."""
    samples = [m for m in measured if isinstance(m, OdometrySample)]
    known = 0.0
    for before, after in pairwise(samples):
        seconds = max(1e-9 * (after.stamp_ns - before.stamp_ns), 0.0)
        motion = Motion(relative(before.pose_odom_base, after.pose_odom_base), seconds)
        variance = left_variance(motion, localizer.odometry_noise)
        known += float(motion.increment[0]) ** 2 / max(variance, 1e-12)
    return float(known**-0.5) if known else float(np.pi)


def broken_promises(drive: CalibrationDrive, given: Calibration) -> dict[str, tuple[float, float]]:
    """
    Quantities given as exact that a drive contradicts: estimated minus given value, and sigma.

    The detections are used again with the default sigmas of these quantities.
    """
    exact = {name for name in NAMES if given[name][1] == 0.0}
    if not exact:
        return {}
    default = Calibration.of_mount(given.mount)
    loose = given.covariance + np.diag(
        [default[name][1] ** 2 if name in exact else 0.0 for name in NAMES]
    )
    found, _ = drive.again(replace(given, covariance=loose))
    off = {name: (found[name][0] - given[name][0], found[name][1]) for name in exact}
    return {
        name: off[name]
        for name in NAMES
        if name in exact and abs(off[name][0]) > _CONTRADICTION * off[name][1]
    }


def advice(unobserved: Sequence[str]) -> list[tuple[str, tuple[str, ...]]]:
    """Motions that make unobserved quantities observable, and these quantities."""
    wanted = [
        (motion, tuple(name for name in shown if name in unobserved))
        for motion, shown in _SHOWN_BY.items()
    ]
    return [(motion, names) for motion, names in wanted if names]


def trade_offs(found: Calibration) -> list[tuple[str, str, float]]:
    """Pairs of quantities that are not separately observable, and their correlation."""
    sigmas = np.where(found.sigmas > 0.0, found.sigmas, 1.0)
    correlation = found.covariance / np.outer(sigmas, sigmas)
    return [
        (NAMES[i], NAMES[j], float(correlation[i, j]))
        for i in range(len(NAMES))
        for j in range(i + 1, len(NAMES))
        if abs(correlation[i, j]) > _TRADES_OFF
    ]
