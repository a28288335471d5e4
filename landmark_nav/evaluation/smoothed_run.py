"""
Smoothed trajectory of a run, estimated from all of its measurements.

Trajectories are also written as TUM files, which evo and many other tools read.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.calibration import Calibration
from landmark_nav.evaluation.metrics import consistency, error_summary, pose_errors
from landmark_nav.evaluation.replay import Replay
from landmark_nav.localization.estimator import ImagePoints, JointFilter
from landmark_nav.localization.estimator.smoothing import smoothed_poses
from landmark_nav.localization.localizer import LocalizationConfig
from landmark_nav.storage.atomic_io import write_atomically
from landmark_nav.types import FloatArray, LandmarkMap

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
    return Smoothed(
        np.array([pose.stamp_ns for pose in poses], dtype=np.int64),
        np.array([pose.pose for pose in poses]),
        np.array([pose.covariance for pose in poses]),
    )


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
    nees = consistency(errors, smoothed.covariances)
    return {
        **error_summary(errors),
        'nees': {
            'mean': nees.mean if nees else None,
            'inside_95': nees.inside_95 if nees else None,
        },
    }


def write_tum_files(
    run: Replay, folder: Path, smoothed: Smoothed | None = None
) -> tuple[Path, ...]:
    """
    Write ``truth.tum``, ``fused.tum``, ``triangulation.tum`` and others; return their paths.

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
    paths = []
    for name, (at_ns, poses) in tracks.items():
        known = np.flatnonzero(np.isfinite(poses).all(axis=1))
        if len(known):
            # Images may have arrived late.
            known = known[np.argsort(at_ns[known], kind='stable')]
            paths.append(folder / f'{name}.tum')
            write_atomically(paths[-1], _lines(at_ns[known], poses[known]))
    return tuple(paths)


def _lines(stamps_ns: npt.NDArray[np.int64], poses: FloatArray) -> str:
    """Format lines ``timestamp tx ty tz qx qy qz qw`` without loss of precision."""
    return ''.join(
        f'{stamp // 10**9}.{stamp % 10**9:09d} {x!r} {y!r} 0 0 0 '
        f'{float(np.sin(heading / 2.0))!r} {float(np.cos(heading / 2.0))!r}\n'
        for stamp, (x, y, heading) in zip(stamps_ns.tolist(), poses.tolist(), strict=True)
    )
