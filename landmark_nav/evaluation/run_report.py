"""
The metrics of a run, as ``landmark-nav evaluate --json`` writes them, and its smoothing.

Ground truth is transformed to the frame and the scale of a map that has its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation import metrics
from landmark_nav.evaluation.metrics import consistency, error_summary, pose_errors
from landmark_nav.evaluation.replay import Replay
from landmark_nav.geometry import se2
from landmark_nav.localization.estimator.factors import ImagePoints
from landmark_nav.localization.estimator.filter import JointFilter
from landmark_nav.localization.estimator.integrity import Status
from landmark_nav.localization.estimator.smoothing import smoothed_poses
from landmark_nav.localization.estimator.state import Update
from landmark_nav.localization.localizer import LocalizationConfig, LocalizationUpdate
from landmark_nav.storage.atomic_io import write_atomically
from landmark_nav.types import FloatArray, LandmarkMap

SCHEMA = 1
_ESTIMATES = ('fused', 'triangulation', 'odometry')
# Noise of the odometry that is learned.
_NOISE = ('along_m_per_sqrt_m', 'turn_rad_per_sqrt_m', 'turn_rad_per_sqrt_rad', 'slip_m_per_rad')
# Least availability without a warning.
_MOSTLY = 0.5


def run_report(
    run: Replay, landmark_map: LandmarkMap, calibration: Calibration, config: LocalizationConfig
) -> dict[str, Any]:
    """
    Metrics of a run with this prior calibration, by the keys of the contract.

    Metrics that require ground truth are None if the bag has none; ``found`` is None if the start
    was given; ``spells`` are the stretches of images in which the state was degraded or lost;
    ``warning`` says why the metrics mean little, and is None if they are meaningful.
    """
    bound = bound_of(run, landmark_map, calibration, config)
    median_ms, p95_ms = (1e3 * np.percentile(run.update_seconds, (50, 95))).tolist()
    stamps = run.stamps_ns
    span_s = 1e-9 * float(max(stamps[-1], run.odometry.stamps_ns[-1]) - run.begin_ns)
    of_poses = pose_report(run, landmark_map, bound.independent)
    # Before the place was found, the pose was unknown.
    lost = float(run.lost[stamps >= run.start.stamp_ns].mean())
    after_s = 1e-9 * float(run.start.stamp_ns - run.begin_ns)
    return {
        **of_poses,
        'crlb_ratio': metrics.crlb_ratio(run.errors.fused, bound.covariances),
        'update_ms': {'median': median_ms, 'p95': p95_ms},
        'realtime_factor': span_s / run.seconds,
        'result_hash': metrics.result_hash(stamps, run.fused, run.fixes),
        'calibration': run.calibration and run.calibration.differences(calibration),
        'odometry_noise': {name: getattr(run.odometry_noise, name) for name in _NOISE},
        'sighting_sigma': run.detection_sigma_factor,
        'found': {'after_s': after_s, 'pose': list(run.start.pose)} if run.searched else None,
        'warning': f'lost in {100.0 * lost:.0f} % of the images, where fused is but '
        'odometry: is the map of this room, and robot.yaml of this robot?'
        if 1.0 - lost < _MOSTLY
        else None,
    }


def bound_of(
    run: Replay, landmark_map: LandmarkMap, calibration: Calibration, config: LocalizationConfig
) -> metrics.Bound:
    """Bound of the errors of a run with this prior calibration."""
    known = calibration if run.calibration is None else run.calibration
    images = [_used(update, run.detection_sigma_factor) for update in run.updates]
    true = replace(calibration, values=known.values)
    return metrics.posterior_bound(run.truth, images, landmark_map, true, config, run.start)


def pose_report(
    run: Replay, landmark_map: LandmarkMap, independent: float = np.nan
) -> dict[str, Any]:
    """
    Metrics that depend on the poses of a run only; ``claimed`` are their sigmas.

    `independent` is that of `metrics.Bound`; without it there is no interval of NEES.
    """
    images = len(run.searched) + len(run.updates)
    nees = _nees(run.errors.fused, run.fused_covariances)
    known = nees['mean'] is not None and np.isfinite(independent)
    sigma = np.sqrt(np.diagonal(run.fused_covariances, axis1=1, axis2=2))
    sigma_m = np.hypot(sigma[:, 0], sigma[:, 1])
    return {
        'schema': SCHEMA,
        'frames': images,
        'fixes': int(np.sum(np.isfinite(run.fixes[:, 0]))),
        'availability': float(np.sum(~run.lost)) / images,
        'landmarks': len(landmark_map.landmarks),
        **_summaries(run),
        'nees': nees
        | {'interval_95': list(metrics.nees_interval_95(independent)) if known else None},
        'claimed': {
            'position_median_m': float(np.median(sigma_m)),
            'position_p95_m': float(np.percentile(sigma_m, 95)),
            'heading_median_deg': float(np.degrees(np.median(sigma[:, 2]))),
        },
        'silently_wrong': _undetected(run),
        'spells': spells(run),
        'integrity': integrity_report(run),
    }


def _summaries(run: Replay) -> dict[str, Any]:
    """Metrics of the errors of each estimate."""
    return {name: error_summary(getattr(run.errors, name)) for name in _ESTIMATES}


def _nees(errors: FloatArray, covariances: FloatArray) -> dict[str, Any]:
    mean, inside_95 = consistency(errors, covariances) or (None, None)
    return {'mean': mean, 'inside_95': inside_95}


def _undetected(run: Replay) -> int | None:
    """Images that are off by over 5 sigma while the state is OK; None without ground truth."""
    if not len(run.truth):
        return None
    return metrics.undetected_failures(run.errors.fused, run.fused_covariances, run.tracking)


def integrity_report(run: Replay) -> dict[str, Any] | None:
    """
    Check the protection levels of a run; None without levels or ground truth.

    `coverage_99` is the share of images with position and heading inside, by quarter from the
    smallest to the largest level of the position; `undetected_wrong` counts images that are off by
    over 5 sigma while the state is OK.
    """
    errors = run.errors.fused
    levels = [(k, update.level) for k, update in enumerate(run.updates) if update.level]
    levels = [(k, level) for k, level in levels if np.isfinite(errors[k]).all()]
    if not levels:
        return None
    which = [k for k, _ in levels]
    level = np.array([tuple(each) for _, each in levels])
    off = np.column_stack([np.hypot(*errors[which, :2].T), np.abs(errors[which, 2])])
    inside = np.asarray((off <= level).all(axis=1))
    quarters = np.array_split(inside[np.argsort(level[:, 0], kind='stable')], 4)
    return {
        'coverage_99': float(inside.mean()),
        'coverage_99_by_quarter': [float(part.mean()) for part in quarters if len(part)],
        'level_over_error_median': float(np.median(level[:, 0] / np.maximum(off[:, 0], 1e-9))),
        'undetected_wrong': _undetected(run),
    }


def spells(run: Replay) -> list[dict[str, Any]]:
    """List the times at which the state was not OK, with the first reason of each."""
    spells = (list(group) for _, group in groupby(run.updates, key=lambda u: u.status))
    return [
        {
            'status': first.status,
            'from_s': (first.stamp_ns - run.begin_ns) * 1e-9,
            'to_s': (last.stamp_ns - run.begin_ns) * 1e-9,
            'reason': first.reason,
        }
        for first, *_, last in ((spell[0], *spell) for spell in spells)
        if first.status != Status.OK.value
    ]


def _used(update: LocalizationUpdate, sigma_factor: float) -> ImagePoints:
    """Return the points of an image that the estimator used, with learned noise."""
    seen, taken = update.points, update.taken
    if seen is None or not isinstance(taken, Update):
        return ImagePoints.nothing(update.stamp_ns)
    seen = replace(seen, stamp_ns=update.stamp_ns).chosen(np.isin(seen.columns, taken.used))
    return replace(seen, covariance=sigma_factor**2 * seen.covariance)


# Least extent of a path by which it is aligned.
_LEAST_EXTENT_M = 0.05


class Alignment(NamedTuple):
    """
    Pose (3,) of the map's frame in that of the ground truth, and lengths in map over true ones.

    Umeyama, PAMI 13(4), 1991, in the plane.
    """

    pose: FloatArray
    scale: float


def align(poses: FloatArray, truth: FloatArray, scaled: bool) -> Alignment:
    """
    Align poses (n, 3) with the truth (n, 3), by their positions.

    Raises `LandmarkNavError`: too few poses are known in both, or all of one have one position.
    """
    known = np.isfinite(poses).all(1) & np.isfinite(truth).all(1)
    own, true = poses[known, :2], truth[known, :2]
    extents = [np.ptp(places, axis=0).max() for places in (own, true) if len(places)]
    if len(own) < 2 or min(extents) < _LEAST_EXTENT_M:
        raise LandmarkNavError('the drive is too short to align its map with ground_truth/odom')
    middle, true_middle = own.mean(0), true.mean(0)
    a, b = own - middle, true - true_middle
    cosine, sine = np.sum(a * b), np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    turn = float(np.arctan2(sine, cosine))
    # Lengths in the map over true ones: the factor for the truth.
    scale = float(np.sum(a * a) / np.hypot(cosine, sine)) if scaled else 1.0
    origin = true_middle - se2.rotation(turn) @ middle / scale
    return Alignment(np.array([*origin, turn]), scale)


def aligned(run: Replay, scaled: bool) -> tuple[Replay, Alignment]:
    """Transform the ground truth to the frame of the map; return run and alignment."""
    poses = np.where(run.lost[:, None], np.nan, run.fused)
    found = align(poses, run.truth.at(run.stamps_ns), scaled)
    truth = run.truth.seen_from(found.pose, found.scale)
    if scaled:
        truth = _likeliest(run, truth, poses)
    return replace(run, truth=truth), found


def _likeliest(run: Replay, truth: metrics.PoseTrack, poses: FloatArray) -> metrics.PoseTrack:
    """Refine the alignment of the truth to the likeliest one, by headings and covariances."""
    # The choice of the map's frame is not an error of the poses.
    errors = metrics.pose_errors(poses, truth.at(run.stamps_ns))
    known = np.isfinite(errors).all(1)
    at, information = poses[known], np.linalg.inv(run.fused_covariances[known])
    by_frame = np.zeros((len(at), 3, 4))
    by_frame[:, 0, 0] = by_frame[:, 1, 1] = by_frame[:, 2, 2] = 1.0
    by_frame[:, 0, 2], by_frame[:, 1, 2] = -at[:, 1], at[:, 0]
    by_frame[:, :2, 3] = at[:, :2]
    normal = np.einsum('nki,nkl,nlj->ij', by_frame, information, by_frame)
    pull = np.einsum('nki,nkl,nl->i', by_frame, information, errors[known])
    *moved, grown = np.linalg.solve(normal, pull).tolist()
    return truth.seen_from(se2.inverse(np.array(moved)), 1.0 + grown)


# The ground truth is in another frame or unit if that explains all but this share of the errors.
_LEFT = 0.1


def other_frame(run: Replay) -> str | None:
    """Text: what of the ground truth explains the errors of a run, if its frame or unit does."""
    try:
        moved, (pose, scale) = aligned(run, scaled=True)
    except LandmarkNavError:
        return None
    errors = run.errors.fused
    (was, left) = (np.nanmean(np.square(e[:, :2])) for e in (errors, moved.errors.fused))
    white = np.linalg.solve(run.fused_covariances, errors[..., None])[..., 0]
    if left > _LEFT**2 * was or np.nanmean(np.sum(errors * white, 1)) < _FAR:
        return None
    x, y, turn = pose.tolist()
    unit = '' if abs(np.log(scale)) < _LEFT else f', and lengths are {1.0 / scale:.4g} times those'
    return f'the map lies at ({x:.2f}, {y:.2f}), {np.degrees(turn):.1f} deg in its frame{unit}'


def against_truth(run: Replay, landmark_map: LandmarkMap) -> tuple[Replay, dict[str, Any]]:
    """
    A run and metrics of its alignment; these are empty for a map in the true frame.

    For a map with its own frame, errors are those after one rigid transformation; `scale` and the
    errors after scaling are separate metrics. The truth of the run is then in the scale of the
    map, like the covariance of a pose, so that consistency is judged in that scale.
    """
    if not (landmark_map.has_own_frame and len(run.truth)):
        return run, {}
    rigid, _ = aligned(run, scaled=False)
    in_metre, alignment = aligned(run, scaled=True)
    return in_metre, {
        'aligned': True,
        'scale': alignment.scale,
        **_summaries(rigid),
        'fused_after_scale': error_summary(in_metre.errors.fused),
    }


# Bound of the squared normalised difference of three values, as improbable as five sigmas of one.
_FAR = 31.8


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Poses (n, 3) of ``base_link`` at the images, and covariances, given all measurements."""

    stamps_ns: npt.NDArray[np.int64]
    poses: FloatArray
    covariances: FloatArray


def smooth_run(
    run: Replay, landmark_map: LandmarkMap, calibration: Calibration, config: LocalizationConfig
) -> Smoothed:
    """
    Smooth over all images of a run.

    From the last image that was used before the pose was lost until it was found again, the motion
    is unknown.
    """
    # Images may have arrived late.
    order = np.argsort(run.stamps_ns, kind='stable')
    updates = [run.updates[k] for k in order if run.updates[k].stamp_ns >= run.start.stamp_ns]
    lost, used = np.zeros(len(updates), dtype=np.bool_), 0
    for k, update in enumerate(updates):
        if update.status == 'lost':
            lost[used : k + 1] = True
        elif update.used:
            used = k + 1
    track = run.track(config.odometry)
    images = []
    for update, unknown in zip(updates, lost, strict=True):
        seen = update.points or ImagePoints.nothing(update.stamp_ns)
        near = update.fused.pose if unknown else seen.near
        images.append(replace(seen, stamp_ns=update.stamp_ns, near=near))
    joint = JointFilter(landmark_map, calibration, run.start, config.estimator, config.odometry)
    poses = smoothed_poses(joint, track, images, lost)
    stamps = np.array([pose.stamp_ns for pose in poses], dtype=np.int64)
    covariances = np.array([pose.covariance for pose in poses])
    return Smoothed(stamps, np.array([pose.pose for pose in poses]), covariances)


def departures(run: Replay, smoothed: Smoothed) -> str:
    """
    Describe where the smoothed trajectory differs from the filter's; empty if it does not.

    The filter inflates covariances if wheels, camera or clock seem wrong; the smoother does not.
    """
    fused = {update.stamp_ns: update.fused for update in run.updates}
    both = [fused[stamp] for stamp in smoothed.stamps_ns.tolist()]
    apart = pose_errors(smoothed.poses, np.array([one.pose for one in both]))
    spread = smoothed.covariances + np.array([one.covariance for one in both])
    squares = np.einsum('ni,nij,nj->n', apart, np.linalg.inv(spread), apart)
    far = np.flatnonzero(squares > _FAR)
    if not len(far):
        return ''
    seconds = 1e-9 * (smoothed.stamps_ns[far[[0, -1]]] - run.begin_ns)
    way = np.hypot(*apart[far, :2].T).max()
    return (
        f'{way:.2f} m and {np.degrees(np.abs(apart[far, 2]).max()):.1f} deg at most between '
        f'{seconds[0]:.1f} and {seconds[1]:.1f} s'
    )


def smoothed_report(run: Replay, smoothed: Smoothed) -> dict[str, Any]:
    """Metrics of the smoothed trajectory: errors, as for the other estimates, and NEES."""
    errors = pose_errors(smoothed.poses, run.truth.at(smoothed.stamps_ns))
    return {**error_summary(errors), 'nees': _nees(errors, smoothed.covariances)}


def write_tum_files(run: Replay, folder: Path, smoothed: Smoothed | None = None) -> None:
    """
    Write ``truth.tum``, ``fused.tum``, ``triangulation.tum`` and others.

    All are at the stamps of the images, so that other tools compare the same pairs of poses as
    `landmark_nav.evaluation.metrics`; a pose that is unknown at a stamp has no line.
    """
    stamps = run.stamps_ns
    tracks = {
        'truth': (stamps, run.truth.at(stamps)),
        'fused': (stamps, run.fused),
        'triangulation': (stamps, run.fixes),
        'odometry': (stamps, run.odometry.at(stamps)),
    }
    if smoothed is not None:
        tracks['smoothed'] = smoothed.stamps_ns, smoothed.poses
    for name, (at_ns, poses) in tracks.items():
        known = np.flatnonzero(np.isfinite(poses).all(axis=1))
        # Images may have arrived late.
        known = known[np.argsort(at_ns[known], kind='stable')]
        # Lines ``timestamp tx ty tz qx qy qz qw`` without loss of precision.
        lines = [
            f'{stamp // 10**9}.{stamp % 10**9:09d} {x!r} {y!r} 0 0 0 '
            f'{float(np.sin(heading / 2.0))!r} {float(np.cos(heading / 2.0))!r}\n'
            for stamp, (x, y, heading) in zip(
                at_ns[known].tolist(), poses[known].tolist(), strict=True
            )
        ]
        if lines:
            write_atomically(folder / f'{name}.tum', ''.join(lines))


def path_of(run: Replay, stamps_ns: npt.NDArray[np.int64], poses: FloatArray) -> FloatArray:
    """Line (2, n) through poses; between images that are far apart it follows odometry."""
    known = metrics.PoseTrack.of(zip(stamps_ns.tolist(), poses, strict=True))
    return np.asarray(run.odometry.carry(known).poses[:, :2].T)


# Percentage of the images whose bands are completely inside the axes.
_SHOWN_SHARE = 98.0
_AXES = (('ahead [cm]', 100.0), ('left [cm]', 100.0), ('heading [deg]', 180.0 / np.pi))


class AxisErrors(NamedTuple):
    """
    Errors (n,) ahead, to the left or in heading, in centimetres or degrees.

    `band` are three sigmas; `limit` is the half height of the axes.
    """

    label: str
    factor: float
    fused: FloatArray
    fixes: FloatArray
    band: FloatArray
    limit: float


def errors_by_axis(run: Replay, fixes: FloatArray) -> list[AxisErrors]:
    """Turn errors in map, of the fused poses and of `fixes` (n, 3), into the robot's frame."""
    turned = se2.rot_z(-run.fused[:, 2])
    covariances = turned @ run.fused_covariances @ turned.transpose(0, 2, 1)
    bands = 3.0 * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    fused, fixes = (np.einsum('nij,nj->ni', turned, e) for e in (run.errors.fused, fixes))
    found = []
    for k, (label, factor) in enumerate(_AXES):
        band, off = factor * bands[:, k], factor * fused[:, k]
        # The sigmas of a lost pose, and of a rough start, may be large: these bands exceed the
        # axes.
        widest = np.percentile(band[~run.lost], _SHOWN_SHARE) if not run.lost.all() else np.nan
        shown = np.append(np.abs(off), widest)
        limit = 1.15 * float(np.nanmax(shown)) if np.isfinite(shown).any() else 1.0
        found.append(AxisErrors(label, factor, off, factor * fixes[:, k], band, limit))
    return found
