"""
Tracks of poses, metrics of a run, and the posterior Cramer-Rao bound.

Errors are absolute in ``map`` without alignment, so that they include errors of map and start.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
import hashlib
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from landmark_nav.arrays import IntArray
from landmark_nav.calibration import Calibration
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.estimator.factors import ImagePoints, project
from landmark_nav.localization.estimator.filter import JointFilter
from landmark_nav.localization.estimator.smoothing import ErrorRepetition
from landmark_nav.localization.estimator.timeline import move_to
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.types import FloatArray, LandmarkMap, OdometrySample, PoseEstimate


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Planar poses (n, 3) at strictly increasing times: x [m], y [m], heading [rad]."""

    stamps_ns: IntArray
    poses: FloatArray

    @classmethod
    def of(cls, stamped: Iterable[tuple[int, FloatArray]]) -> PoseTrack:
        """Sort stamped poses (3,); of several with one stamp the last is kept."""
        by_stamp = dict(stamped)
        stamps = sorted(by_stamp)
        poses = [by_stamp[stamp] for stamp in stamps]
        return cls(np.array(stamps, np.int64), np.array(poses, np.float64).reshape(-1, 3))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def seen_from(self, pose: FloatArray, scale: float = 1.0) -> PoseTrack:
        """Transform the track to the frame of a pose (3,), with positions scaled by `scale`."""
        poses = se2.relative(pose, self.poses)
        return PoseTrack(self.stamps_ns, poses * [scale, scale, 1.0])

    def carry(self, known: PoseTrack) -> PoseTrack:
        """Propagate `known` poses by this track, each to the next one; NaN outside its times."""
        inside = (self.stamps_ns > known.stamps_ns[0]) & (self.stamps_ns < known.stamps_ns[-1])
        stamps = np.union1d(known.stamps_ns, self.stamps_ns[inside])
        last = np.searchsorted(known.stamps_ns, stamps, 'right') - 1
        moved = se2.relative(self.at(known.stamps_ns[last]), self.at(stamps))
        moved[stamps == known.stamps_ns[last]] = 0.0
        return PoseTrack(stamps, se2.compose(known.poses[last], moved))

    def at(self, stamps_ns: npt.ArrayLike) -> FloatArray:
        """Interpolate at constant twist in SE(2): (m, 3), NaN outside the known times."""
        stamps = np.atleast_1d(np.asarray(stamps_ns, dtype=np.int64))
        found = np.full((len(stamps), 3), np.nan)
        if not len(self):
            return found
        inside = (stamps >= self.stamps_ns[0]) & (stamps <= self.stamps_ns[-1])
        after = np.clip(np.searchsorted(self.stamps_ns, stamps[inside]), 1, max(1, len(self) - 1))
        if len(self) == 1:
            found[inside] = self.poses[0]
            return found
        before = after - 1
        span = self.stamps_ns[after] - self.stamps_ns[before]
        share = (stamps[inside] - self.stamps_ns[before]) / span
        step = se2.relative(self.poses[before], self.poses[after])
        # Exponential of a share of the logarithm: a chord of the same arc.
        turn = step[:, 2]
        ratio = share * np.sinc(share * turn / (2 * np.pi)) / np.sinc(turn / (2 * np.pi))
        bend = se2.rotation((share - 1.0) * turn / 2.0)
        chord = np.einsum('nij,nj->ni', bend, step[:, :2]) * ratio[:, None]
        part = np.column_stack([chord, share * turn])
        found[inside] = se2.compose(self.poses[before], part)
        return found


# x, y and heading.
_DEGREES_OF_FREEDOM = 3
_FIVE_SIGMA = 5.0
# Resolution of poses in `result_hash`, m and rad.
_RESOLUTION = 1e-6


class Bound(NamedTuple):
    """
    Bound of the covariances (n, 3, 3) of poses at images, and what is independent among them.

    `independent` is the number of independent errors with the same variance of the mean NEES, NaN
    if it is unknown.
    """

    covariances: FloatArray
    independent: float


class Consistency(NamedTuple):
    """
    Normalised estimation errors squared.

    With consistent covariances the expectation of `mean` is 3. `inside_95` is the share of errors
    within the 95 % bound of a single error.
    """

    mean: float
    inside_95: float


def pose_errors(poses: npt.ArrayLike, truth: npt.ArrayLike) -> FloatArray:
    """Estimated minus true x, y [m] and wrapped heading [rad]; NaN if either is unknown."""
    errors = np.asarray(poses, dtype=np.float64) - np.asarray(truth, dtype=np.float64)
    errors[:, 2] = wrap_rad(errors[:, 2])
    return errors


def error_summary(errors: FloatArray) -> dict[str, float | None]:
    """Metrics of the contract from errors (n, 3); None if all errors are unknown."""
    known = errors[np.all(np.isfinite(errors), axis=1)]
    position, heading = np.hypot(known[:, 0], known[:, 1]), np.degrees(np.abs(known[:, 2]))
    return {
        f'{name}_{unit}': float(summary(of)) if len(known) else None
        for name, unit, of, summary in (
            ('position_rmse', 'm', position, _rms),
            ('position_median', 'm', position, np.median),
            ('position_p95', 'm', position, _p95),
            ('position_max', 'm', position, np.max),
            ('heading_rmse', 'deg', heading, _rms),
            ('heading_p95', 'deg', heading, _p95),
        )
    }


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _p95(values: FloatArray) -> float:
    return float(np.percentile(values, 95))


def consistency(errors: FloatArray, covariances: FloatArray) -> Consistency | None:
    """
    Compare errors (n, 3), NaN if unknown, with their estimated covariances (n, 3, 3).

    None if all errors are unknown.
    """
    known = np.all(np.isfinite(errors), axis=1)
    if not np.any(known):
        return None
    roots = np.linalg.cholesky(covariances[known])
    white = np.linalg.solve(roots, errors[known][..., None])[..., 0]
    nees = np.sum(white * white, axis=1)
    bound = chdtri(_DEGREES_OF_FREEDOM, 0.05)
    return Consistency(float(np.mean(nees)), float(np.mean(nees < bound)))


def nees_interval_95(independent: float) -> tuple[float, float]:
    """
    Interval that holds the mean NEES of 19 of 20 runs with so many independent errors.

    Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
    section 5.4.
    """
    n = independent
    low, high = (chdtri(_DEGREES_OF_FREEDOM * n, [0.975, 0.025]) / n).tolist()
    return low, high


def undetected_failures(
    errors: FloatArray, covariances: FloatArray, tracking: npt.NDArray[np.bool_]
) -> int:
    """Count OK states, by the mask `tracking` (n,), with an error beyond five sigmas."""
    claimed = tracking & np.all(np.isfinite(errors), axis=1)
    position = errors[claimed, :2]
    weighted = np.linalg.solve(covariances[claimed, :2, :2], position[..., None])[..., 0]
    away = np.sum(position * weighted, axis=1) > _FIVE_SIGMA**2
    turned = errors[claimed, 2] ** 2 > _FIVE_SIGMA**2 * covariances[claimed, 2, 2]
    return int(np.sum(away | turned))


def crlb_ratio(errors: FloatArray, bound: FloatArray) -> float | None:
    """Position RMSE over the root of the mean `posterior_bound`."""
    known = np.all(np.isfinite(errors), axis=1) & np.all(np.isfinite(bound), axis=(1, 2))
    if not np.any(known):
        return None
    mean_square = np.mean(np.sum(errors[known, :2] ** 2, axis=1))
    least = np.mean(np.trace(bound[known, :2, :2], axis1=1, axis2=2))
    return float(np.sqrt(mean_square / least))


def result_hash(stamps_ns: npt.NDArray[np.int64], fused: FloatArray, fixes: FloatArray) -> str:
    """SHA-256 of the rounded results of a run, which is reproducible."""
    digest = hashlib.sha256(np.ascontiguousarray(stamps_ns, dtype='<i8').tobytes())
    for poses in (fused, fixes):
        steps = np.where(np.isfinite(poses), np.rint(poses / _RESOLUTION), np.iinfo(np.int64).min)
        digest.update(np.ascontiguousarray(steps.astype('<i8')).tobytes())
    return digest.hexdigest()


@np.errstate(invalid='raise')
def posterior_bound(
    truth: PoseTrack,
    images: Sequence[ImagePoints],
    landmark_map: LandmarkMap,
    calibration: Calibration,
    config: LocalizationConfig,
    start: PoseEstimate,
) -> Bound:
    """
    Bound of the covariance of the pose at each image, NaN where the truth is unknown.

    For a nonlinear system with Gaussian noise the bound obeys the covariance recursion of the
    extended Kalman filter linearised along the true trajectory (Taylor, IEEE Trans. Automatic
    Control 24(2), 1979; Tichavsky, Muravchik and Nehorai, IEEE Trans. Signal Processing 46(5),
    1998). The filter therefore runs on the truth without noise, with the noise models, the joint
    covariance of map and calibration, the covariance of the start, and the landmarks that the run
    used. `calibration` has true values and the covariance of the prior. If the true motion is
    impossible, all is NaN.
    """
    bound = np.full((len(images), 3, 3), np.nan)
    unknown = Bound(bound, np.nan)
    begin = max(start.stamp_ns, int(truth.stamps_ns[0])) if len(truth) else 0
    poses = truth.at([begin, *(seen.stamp_ns for seen in images)])
    if np.isnan(poses[0]).any():
        return unknown
    # Points without noise must not adapt the noise models, and cannot be outliers.
    adapted = ('tail_freedom', 'step_probability', 'moved_probability', 'learning_sigma')
    noise = replace(config.estimator, **dict.fromkeys(adapted, 0.0))
    start = PoseEstimate(begin, poses[0], start.covariance)
    ideal = JointFilter(landmark_map, calibration, start, noise, config.odometry)
    track = OdometryTrack(config.odometry)
    moved = int(np.searchsorted(truth.stamps_ns, begin))
    repetition = ErrorRepetition(len(images))
    try:
        for k, (seen, pose) in enumerate(zip(images, poses[1:], strict=True)):
            if np.isnan(pose).any() or seen.stamp_ns < begin:
                continue
            while moved < len(truth) and truth.stamps_ns[moved] <= seen.stamp_ns:
                track.add(OdometrySample(int(truth.stamps_ns[moved]), truth.poses[moved]))
                moved += 1
            track.add(OdometrySample(seen.stamp_ns, pose))
            before = ideal.state
            move_to(seen.stamp_ns, ideal, track)
            state = ideal.state
            points = project(
                state.mean,
                landmark_map.positions[seen.columns],
                replace(seen, moved_back=state.moved_back),
            ).points
            ideal.observe(replace(seen, points=points, near=None))
            bound[k] = ideal.estimate.covariance
            repetition.add(before, state, ideal)
            ideal.mark()
    except (np.linalg.LinAlgError, FloatingPointError):
        bound[:] = np.nan
        return unknown
    return Bound(bound, repetition.independent)
