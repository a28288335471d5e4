"""The metrics of learning, as ``learn --json`` writes them, and their ground truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.metrics import pose_errors, PoseTrack
from landmark_nav.geometry import se2
from landmark_nav.learning.pipeline import LearningResult
from landmark_nav.learning.stages import StageLog
from landmark_nav.localization.triangulation.model import base_from_axis
from landmark_nav.messages import decode
from landmark_nav.quality import PanoramaQuality
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.reader import decoded
from landmark_nav.storage.bags.sensors import truth_decoder
from landmark_nav.types import FloatArray, Landmark, Panorama, Refusal

SCHEMA = 1
# Where landmarks on planes of their own are counted.
NO_WALL = 'no wall'


def learning_report(
    result: LearningResult,
    measured: Sequence[Panorama],
    frames: Sequence[int],
    truth: PoseTrack,
    known: Calibration,
    log: StageLog,
    seconds: float,
) -> dict[str, Any]:
    """
    Metrics of learning; errors by the `truth` of ``base_link``, if there is one.

    `measured` are panoramas before the adjustment, with poses by the papers alone, or by
    ``sweep/pose``; `frames` are the numbers of frames of the sweeps. What is `known` of the mount
    gives the pose of the base. For a map with its own frame, the truth is in the frame of the
    first sweep; covariances do not contain the error of the scale, so NEES is that after scaling.
    """
    own_frame = result.map.has_own_frame
    scales = [
        _scale(group, truth, known) if own_frame else 1.0 for group in (result.panoramas, measured)
    ]
    after, before_it = (truth.seen_from(np.zeros(3), scale) for scale in scales)
    outcomes = [outcome for group in result.outcomes for outcome in group]
    refused = Counter(o.reason for o in outcomes if isinstance(o, Refusal))
    walls = Counter(landmark.wall_id or NO_WALL for landmark in result.map.landmarks)
    return {
        'schema': SCHEMA,
        'sweeps': [
            {
                'stamp_ns': panorama.stamp_ns,
                'frames': count,
                **_place(panorama, truth, after, known, own_frame),
                'measured': _place(before, truth, before_it, known, own_frame),
                'panorama': quality_report(panorama.quality or PanoramaQuality()),
                'candidates': len(group),
                'elected': sum(isinstance(outcome, Landmark) for outcome in group),
            }
            for panorama, before, count, group in zip(
                result.panoramas, measured, frames, result.outcomes, strict=True
            )
        ],
        **({'scale': scales[0]} if own_frame else {}),
        'candidates': len(outcomes),
        'ambiguous': dict(Counter(r.reason for g in result.ambiguous for r in g).most_common()),
        'reconstructed': result.reconstructed,
        'elected': len(result.map.landmarks),
        'refused': dict(refused.most_common()),
        'landmarks_per_wall': dict(sorted(walls.items())),
        'walls': {
            k.wall_id: {'patches': k.patches, 'before_m': k.off_m, 'sigma_m': k.sigma_m}
            for k in result.walls
        },
        'stages': {
            stage: {'seconds': took, 'peak_memory_mb': log.peak_memory_mb[stage]}
            for stage, took in log.seconds.items()
        },
        'seconds': seconds,
    }


def quality_report(quality: PanoramaQuality) -> dict[str, Any]:
    """Metrics of a panorama; terms of the calibration in radians, metres, or relative."""
    closure = quality.closure_rad
    entry = {
        'sharpness': quality.sharpness,
        'closure_deg': None if closure is None else abs(float(np.degrees(closure))),
        'residual_px': quality.residual_px,
        'residual_before_px': quality.before_px,
        'vignetting': quality.vignetting,
        'gain_spread': quality.gain_spread,
    }
    found: dict[str, Any] = {k: v for k, v in entry.items() if v is None or np.isfinite(v)}
    found['calibration'] = {
        term.name: {'value': term.value, 'sigma': term.sigma, 'significant': term.significant}
        for term in quality.calibration
    }
    if quality.gaps_rad:
        found['unmatched_pan_deg'] = np.degrees(quality.gaps_rad).round(1).tolist()
    return found


def _scale(panoramas: Sequence[Panorama], truth: PoseTrack, known: Calibration) -> float:
    """Lengths from the first sweep over true ones; 1 if these are not known."""
    at = np.array([base_from_axis(p.axis, known.mount).pose[:2] for p in panoramas])
    true = truth.at([p.stamp_ns for p in panoramas])[:, :2]
    seen = np.isfinite(true).all(axis=1) & (np.hypot(*true.T) > 0.0)
    return float((at[seen] * true[seen]).sum() / (true[seen] ** 2).sum()) if seen.any() else 1.0


def _place(
    panorama: Panorama, truth: PoseTrack, scaled: PoseTrack, known: Calibration, own_frame: bool
) -> dict[str, Any]:
    """Pose of the base, x [m], y [m], heading [rad], errors, and NEES by the `scaled` truth."""
    base = base_from_axis(panorama.axis, known.mount)
    by_mount = _by_mount(base.pose, panorama, known, own_frame)
    pose, covariance = base.pose, base.covariance + by_mount @ known.covariance @ by_mount.T
    entry: dict[str, Any] = {
        'pose': pose.tolist(),
        'sigma': np.sqrt(np.diag(covariance)).tolist(),
        'sigma_without_mount': np.sqrt(np.diag(base.covariance)).tolist(),
    }
    error = pose_errors(pose[None], truth.at([panorama.stamp_ns]))[0]
    if np.all(np.isfinite(error)):
        entry['error'] = error.tolist()
        entry['error_position_m'] = float(np.hypot(error[0], error[1]))
        entry['error_heading_deg'] = float(np.degrees(abs(error[2])))
        rest = pose_errors(pose[None], scaled.at([panorama.stamp_ns]))[0]
        entry['nees'] = float(rest @ np.linalg.solve(covariance, rest))
    return entry


def _by_mount(
    pose: FloatArray, panorama: Panorama, known: Calibration, own_frame: bool
) -> FloatArray:
    """Derivatives (3, 17) of a pose of the base by the mount, for a measured pose of the axis."""
    # In the frame of the first sweep, the same errors move its base.
    jacobian = np.zeros((3, len(NAMES)))
    which = [NAMES.index(name) for name in ('axis_x', 'axis_y', 'axis_yaw')]
    lever = [*known.mount.axis_xyz[:2], 0.0]
    if own_frame:
        by_frame, _ = se2.compose_jacobians([0.0, 0.0, 0.0], pose)
        by_first, by_base = (_by_axis(np.asarray(at), lever) for at in ([0.0] * 3, pose))
        jacobian[:, which] = by_base - by_frame @ by_first
    elif panorama.by_calibration is not None:
        # A given pose of the base does not depend on the mount, that of the axis does.
        by_axis, _ = se2.compose_jacobians(panorama.axis.pose, np.negative(lever))
        jacobian = by_axis @ panorama.by_calibration[[0, 1, 3]]
        jacobian[:, which] += _by_axis(pose, lever)
    return jacobian


def _by_axis(pose: FloatArray, lever: Sequence[float]) -> FloatArray:
    """Derivatives (3, 3) of a pose of the base by position and yaw of the axis on it."""
    by_pose, by_lever = se2.compose_jacobians(pose, lever)
    jacobian = -by_lever
    jacobian[:2, 2] = by_pose[:2, 2]
    return jacobian


def truth_of_bag(bag: Bag) -> PoseTrack:
    """Read the ground truth of a bag; empty if it has none."""
    topic = bag.find('ground_truth/odom')
    if topic is None:
        return PoseTrack.of(())
    poses = decoded(bag, topic, truth_decoder(bag, topic), needed=False)
    return PoseTrack.of((pose.stamp_ns, pose.pose) for pose in poses)


def check_truth_frame(bag: Bag, frame: str) -> None:
    """Warn if the frame of the ground truth of a bag is not `frame`."""
    topic = bag.find('ground_truth/odom')
    first = next(bag.messages([topic]), None) if topic else None
    try:
        found = '' if first is None else str(first.message.header.frame_id)
    except LandmarkNavError:
        return  # the reader of the ground truth reports this
    if found and not decode.same_frame(found, frame):
        bag.warn(
            f'{bag.path}: {topic} is in frame {found}, the map in {frame}: errors are right only '
            'where both are the same'
        )
