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
from landmark_nav.types import LandmarkMap

__all__ = ['departures', 'smooth_run', 'smoothed_report']

# Five sigmas of three numbers.
_FAR = 31.8


def smooth_run(
    run: Replay, landmark_map: LandmarkMap, mount: PanTiltMount, config: LocalizationConfig
) -> Smoothed:
    """
    Smooth over all detections of a run, those that the filter refused included.

    It begins at the filter's poses. Bearings are corrected for the joint delay as it is known at
    the end of the run. Odometry is not used where the filter was lost, from the last
    image that it used before.
    """
    # Images may have come late.
    order = np.argsort(run.stamps_ns, kind='stable')
    updates = [run.updates[k] for k in order if run.updates[k].stamp_ns >= run.start.stamp_ns]
    open_, used = np.zeros(len(updates), dtype=np.bool_), 0
    for k, update in enumerate(updates):
        if update.status == 'lost':
            open_[used : k + 1] = True
        elif update.fusion.degrees:
            used = k + 1
    return smooth(
        run.start,
        run.samples,
        [seen_in_time(update.observation.detections, run.late) for update in updates],
        np.array([update.fused.pose for update in updates]),
        landmark_map,
        mount,
        config.fusion,
        config.odometry,
        open_,
    )


def departures(run: Replay, smoothed: Smoothed) -> str:
    """
    Where the line is far from the filter's, in words; empty if it is not.

    The filter inflates covariances where wheels, camera or clock seem wrong; the line does not.
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
