"""Ground truth in the frame and the metre of a map that has its own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.evaluation.metrics import error_summary, pose_errors
from landmark_nav.evaluation.replay import Replay
from landmark_nav.evaluation.run_report import run_errors, RunErrors
from landmark_nav.evaluation.tracks import PoseTrack
from landmark_nav.geometry import se2
from landmark_nav.types import FloatArray

__all__ = ['Alignment', 'align', 'aligned', 'aligned_report']

# Ways that are shorter show no heading, metres.
_LEAST_EXTENT_M = 0.05


class Alignment(NamedTuple):
    """
    Pose (3,) of the map's frame in that of the ground truth, and the map's metre in true ones.

    Umeyama, PAMI 13(4), 1991, in the plane.
    """

    pose: FloatArray
    scale: float

    def in_map(self, truth: PoseTrack, scaled: bool) -> PoseTrack:
        """Ground truth in the frame of the map; in its metre, too, if `scaled`."""
        return truth.seen_from(self.pose, self.scale if scaled else 1.0)


def align(poses: FloatArray, truth: FloatArray, scaled: bool) -> Alignment:
    """
    Align poses (n, 3) with the truth (n, 3), by their positions.

    Raises
    ------
    LandmarkNavError
        Too few of both, or all in one place.

    """
    known = np.isfinite(poses).all(1) & np.isfinite(truth).all(1)
    own, true = poses[known, :2], truth[known, :2]
    if len(own) < 2 or np.ptp(own, axis=0).max() < _LEAST_EXTENT_M:
        raise LandmarkNavError('the drive is too short to align its map with ground_truth/odom')
    middle, true_middle = own.mean(0), true.mean(0)
    a, b = own - middle, true - true_middle
    cosine, sine = np.sum(a * b), np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    turn = float(np.arctan2(sine, cosine))
    # Of the map's ways over the true ones: what truth is multiplied by.
    scale = float(np.sum(a * a) / np.hypot(cosine, sine)) if scaled else 1.0
    origin = true_middle - se2.rotation(turn) @ middle / scale
    return Alignment(np.array([*origin, turn]), scale)


def aligned(run: Replay, scaled: bool) -> tuple[Replay, RunErrors, Alignment]:
    """A run with its ground truth in the frame of the map, its errors, and how it was aligned."""
    poses = np.where(run.lost[:, None], np.nan, run.fused)
    found = align(poses, run.truth.at(run.stamps_ns), scaled)
    truth = found.in_map(run.truth, scaled)
    if scaled:
        truth = _likeliest(run, truth, poses)
    moved = replace(run, truth=truth)
    return moved, run_errors(moved), found


def _likeliest(run: Replay, truth: PoseTrack, poses: FloatArray) -> PoseTrack:
    """
    Ground truth moved, turned and scaled a little more, to where it is likeliest.

    Headings and covariances have a say in that: where a map has its frame is no error of poses.
    """
    errors = pose_errors(poses, truth.at(run.stamps_ns))
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


def aligned_report(rigid: RunErrors, in_metre: RunErrors, alignment: Alignment) -> dict[str, Any]:
    """
    Figures after one rigid transformation; `scale` and what is left after it are beside them.

    The covariance of a pose is in the metre of its map: consistency is taken in that.
    """
    return {
        'aligned': True,
        'scale': alignment.scale,
        'fused': error_summary(rigid.fused),
        'triangulation': error_summary(rigid.triangulation),
        'odometry': error_summary(rigid.odometry),
        'fused_after_scale': error_summary(in_metre.fused),
    }
