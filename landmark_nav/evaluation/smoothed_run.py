"""A run once more, with all of its measurements at hand: the best line that they allow."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.evaluation.metrics import consistency, error_summary, pose_errors
from landmark_nav.evaluation.replay import Replay
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.joint_delay import seen_in_time
from landmark_nav.localization.pipeline import LocalizationConfig
from landmark_nav.localization.smoother import smooth, Smoothed
from landmark_nav.types import LandmarkMap, OdometrySample

__all__ = ['smooth_run', 'smoothed_report']


def smooth_run(
    run: Replay, landmark_map: LandmarkMap, mount: PanTiltMount, config: LocalizationConfig
) -> Smoothed:
    """
    Smooth over all detections of a run, those that the filter refused included.

    It begins at the filter's poses. Bearings are corrected for the joint delay as it is known at
    the end of the run.
    """
    track = run.odometry
    # Pictures may have come late.
    order = np.argsort(run.stamps_ns, kind='stable')
    updates = [run.updates[k] for k in order if run.updates[k].stamp_ns >= run.start.stamp_ns]
    return smooth(
        run.start,
        [OdometrySample(int(t), p) for t, p in zip(track.stamps_ns, track.poses, strict=True)],
        [seen_in_time(update.observation.detections, run.late) for update in updates],
        np.array([update.fused.pose for update in updates]),
        landmark_map,
        mount,
        config.fusion,
        config.odometry,
    )


def smoothed_report(run: Replay, smoothed: Smoothed) -> dict[str, Any]:
    """Figures of the line: its errors, as of the other estimates, and its NEES."""
    errors = pose_errors(smoothed.poses, run.truth.at(smoothed.stamps_ns))
    nees = consistency(errors, smoothed.covariances)
    return {
        **error_summary(errors),
        'nees': {
            'mean': nees.mean if nees else None,
            'inside_95': nees.inside_95 if nees else None,
        },
        'boresight_deg': float(np.degrees(smoothed.boresight_rad)),
        'principal_point_deg': float(np.degrees(smoothed.lens)),
        'iterations': smoothed.iterations,
    }
