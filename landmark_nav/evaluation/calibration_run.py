"""Calibration of a robot from recorded drives: estimate, covariance and residuals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.replay import Replay, replay
from landmark_nav.geometry.se2 import relative
from landmark_nav.localization.estimator.filter import JointFilter
from landmark_nav.localization.estimator.timeline import move_to
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.localization.odometry.noise import left_variance, Motion
from landmark_nav.storage.bags import SensorEvent
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap

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
    'images during pan motion, slow and fast, in both directions': ('joint_delay', 'row_delay'),
    'the same landmarks at the left and at the right border of the image': (
        'principal_point',
        'distortion',
    ),
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
    A drive through the estimator, whose start was found by global localization.

    `calibration` is the estimate at its end. `slip_bound_rad` is the sigma of the direction of
    travel by the learned noise of the wheels, mostly side slip in turns: the least sigma of pan
    zero.
    """

    run: Replay
    calibration: Calibration
    slip_bound_rad: float
    _landmark_map: LandmarkMap
    _config: LocalizationConfig
    _focal_px: float

    @property
    def images(self) -> int:
        """Number of images since the start."""
        return len(self.run.updates)

    @property
    def lost(self) -> int:
        """Number of images in which localization was lost."""
        return int(self.run.lost.sum())

    def again(self, calibration: Calibration) -> tuple[Calibration, Residuals]:
        """Return estimate and residuals by the same detections with another prior."""
        config, start = self._config, self.run.start
        landmarks = self._landmark_map
        joint = JointFilter(landmarks, calibration, start, config.estimator, config.odometry)
        track = self.run.track(config.odometry)
        parts = [(np.empty(0), np.empty((0, 2)), np.empty(0))]
        for update in sorted(self.run.updates, key=lambda update: update.stamp_ns):
            if update.points is None or update.stamp_ns < start.stamp_ns:
                continue
            move_to(update.stamp_ns, joint, track)
            done = joint.observe(replace(update.points, stamp_ns=update.stamp_ns, near=None))
            if not len(done.columns):
                continue
            seconds = np.full(len(done.columns), 1e-9 * (done.stamp_ns - start.stamp_ns))
            parts.append((seconds, self._focal_px * done.residual, done.weight))
        return joint.calibration, Residuals(*map(np.concatenate, zip(*parts, strict=True)))


def calibrate_by_drive(
    events: Iterable[SensorEvent],
    landmark_map: LandmarkMap,
    prior: Calibration,
    config: LocalizationConfig,
) -> CalibrationDrive:
    """
    Estimate the calibration over a drive, without ground truth.

    Raises `LandmarkNavError`: as `replay`, or the drive does not fit the map.
    """
    focal_px = 1.0

    def watched() -> Iterator[SensorEvent]:
        nonlocal focal_px
        for event in events:
            focal_px = event.camera.fx if isinstance(event, CameraFrame) else focal_px
            yield event

    run = replay(watched(), landmark_map, prior, config)
    assert run.calibration is not None, 'it is of a localizer'
    if run.lost.mean() > _MOST_LOST:
        raise LandmarkNavError(
            f'localization is lost in {run.lost.sum()} of {len(run.updates)} images: is the map '
            'of this room, and camera_info of this camera?'
        )
    tilts = [NAMES.index(name) for name in ('axis_roll', 'axis_pitch')]
    level = np.zeros_like(run.calibration.covariance)
    # Exact quantities remain exact.
    level[tilts, tilts] = np.where(prior.sigmas[tilts] > 0.0, _LEVEL_RAD**2, 0.0)
    found = replace(run.calibration, covariance=run.calibration.covariance + level)
    return CalibrationDrive(run, found, _direction_bound(run), landmark_map, config, focal_px)


def _direction_bound(run: Replay) -> float:
    """Sigma of the mean direction of travel, rad, with each step weighted by its information."""
    known = 0.0
    for before, after in pairwise(run.samples):
        seconds = max(1e-9 * (after.stamp_ns - before.stamp_ns), 0.0)
        motion = Motion(relative(before.pose_odom_base, after.pose_odom_base), seconds)
        variance = left_variance(motion, run.odometry_noise)
        known += float(motion.increment[0]) ** 2 / max(variance, 1e-12)
    return float(known**-0.5) if known else float(np.pi)


def contradicted(drive: CalibrationDrive, given: Calibration) -> dict[str, tuple[float, float]]:
    """
    Quantities given as exact that a drive contradicts: estimated minus given value, and sigma.

    The detections are used again with the default sigmas of these quantities.
    """
    exact = [name for name in NAMES if given[name][1] == 0.0]
    if not exact:
        return {}
    default = Calibration.of_mount(given.mount)
    added = [default[name][1] ** 2 if name in exact else 0.0 for name in NAMES]
    loose = given.covariance + np.diag(added)
    found, _ = drive.again(replace(given, covariance=loose))
    off = {name: (found[name][0] - given[name][0], found[name][1]) for name in exact}
    return {name: pair for name, pair in off.items() if abs(pair[0]) > _CONTRADICTION * pair[1]}


def advice(unobserved: Sequence[str]) -> list[tuple[str, tuple[str, ...]]]:
    """Motions that make unobserved quantities observable, and these quantities."""
    wanted = {
        motion: tuple(name for name in shown if name in unobserved)
        for motion, shown in _SHOWN_BY.items()
    }
    return [(motion, names) for motion, names in wanted.items() if names]


def trade_offs(found: Calibration) -> list[tuple[str, str, float]]:
    """Pairs of quantities that are not separately observable, and their correlation."""
    sigmas = np.where(found.sigmas > 0.0, found.sigmas, 1.0)
    correlation = found.covariance / np.outer(sigmas, sigmas)
    pairs = np.argwhere(np.triu(np.abs(correlation) > _TRADES_OFF, 1)).tolist()
    return [(NAMES[i], NAMES[j], float(correlation[i, j])) for i, j in pairs]
