"""
Smoothing: all poses of a recording, each by the whole recording.

The filter runs forward; then each state is corrected by the next smoothed one (Rauch, Tung and
Striebel, Maximum Likelihood Estimates of Linear Dynamic Systems, AIAA Journal 3(8), 1965).
Landmarks join and leave the state: those that join are independent of the state before, and those
that have left are not corrected.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.estimator.factors import CALIBRATION, ImagePoints
from landmark_nav.localization.estimator.filter import JointFilter
from landmark_nav.localization.estimator.state import State
from landmark_nav.localization.estimator.timeline import move_to
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.types import FloatArray, PoseEstimate

# Most images that are compared with all later ones.
_MOST_ANCHORS = 100
# Share of variances by rounding.
_ROUNDING = 1e-12


class _Step(NamedTuple):
    """State after an image, prediction of the next state, and the derivative of that."""

    after: State
    predicted: State
    by_head: FloatArray
    kept: float


def smoothed_poses(
    joint: JointFilter,
    track: OdometryTrack,
    images: Sequence[ImagePoints],
    lost: npt.NDArray[np.bool_] | None = None,
) -> list[PoseEstimate]:
    """
    Return the pose at each image, given all of them.

    Parameters
    ----------
    joint : JointFilter
        Filter at the start; afterwards it is at the last image.
    images : sequence of ImagePoints
        Images in the order of time.
    lost : ndarray of bool, shape (n,), optional
        Images before which the motion is unknown.
    """
    if not images:
        return []
    # What was moved shows at the end, and is then known from the beginning.
    first = copy(joint)
    still = first.still.copy()
    for k, seen in enumerate(images):
        _observe(first, track, seen, lost is not None and bool(lost[k]))
        still[first.state.objects] = first.state.still
    known = joint.knowing(still)
    steps: list[_Step] = []
    for k, seen in enumerate(images):
        after = known.state
        moved = _observe(known, track, seen, lost is not None and bool(lost[k]))
        kept = _kept(known, moved)
        # What is not in the state after the image was an outlier.
        left = np.isin(known.predicted.landmarks, known.state.landmarks)
        steps.append(_Step(after, known.predicted.only(left), moved.carried, kept))
        known.mark()
    joint.state = known.state
    found = [(joint.state.mean, joint.state.covariance)]
    for step in steps[:0:-1]:
        found.append(_backward(step, *found[-1]))
    return [
        PoseEstimate(seen.stamp_ns, mean[:3], covariance[:3, :3])
        for seen, (mean, covariance) in zip(images, reversed(found), strict=True)
    ]


def _observe(joint: JointFilter, track: OdometryTrack, seen: ImagePoints, lost: bool) -> State:
    """Correct a filter by an image, from anywhere if lost; return the state before."""
    move_to(seen.stamp_ns, joint, track)
    if lost:
        joint.forget_pose()
    moved = joint.state
    joint.observe(seen)
    return moved


def _backward(
    step: _Step, mean: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Smoothed mean and covariance of a state, given those of the next."""
    before, after, predicted = step.after.covariance, step.after, step.predicted
    gain = _solved(predicted.covariance, _carried(step, before)).T
    off = mean - predicted.mean
    off[2] = wrap_rad(off[2])
    smoothed = after.mean + gain @ off
    smoothed[2] = wrap_rad(smoothed[2])
    spread = before + gain @ (covariance - predicted.covariance) @ gain.T
    return smoothed, 0.5 * (spread + spread.T)


def _kept(joint: JointFilter, moved: State) -> float:
    """Share of the own errors of landmarks that the prediction of the last image kept."""
    return joint.kept(moved.way_m) if joint.predicted.way_m < moved.way_m else 1.0


def _carried(step: _Step, rows: FloatArray) -> FloatArray:
    """Apply the derivative of the prediction by the state before to the rows (n, k) of that."""
    after, predicted = step.after, step.predicted
    fixed = after.first_own - 2 * len(after.objects)
    carried = np.zeros((len(predicted.mean), rows.shape[1]))
    carried[:CALIBRATION] = step.by_head @ rows[:CALIBRATION]
    carried[CALIBRATION:fixed] = rows[CALIBRATION:fixed]
    both = np.intersect1d(after.objects, predicted.objects)
    carried[predicted.displacements(both)] = rows[after.displacements(both)]
    here, there = np.nonzero(after.landmarks[:, None] == predicted.landmarks)
    for k in range(3):
        own = rows[after.first_own + 3 * here + k]
        carried[predicted.first_own + 3 * there + k] = step.kept * own
    return carried


def _solved(covariance: FloatArray, right: FloatArray) -> FloatArray:
    """Solve for `right` (n, k) with a covariance (n, n), of which exact states have none."""
    variance = np.diag(covariance)
    regular = covariance + np.diag(np.where(variance > 0.0, _ROUNDING * variance, 1.0))
    return np.asarray(cho_solve(cho_factor(regular), right))


class ErrorRepetition:
    """
    How much of the errors of poses at images is the same at other images.

    With the covariances P- and P+ before and after an image, and the derivative F of the state by
    that after the last image, the covariance of the error of the state with any earlier error is
    multiplied by P+ inv(P-) F. The variance of a mean of squares of Gaussian errors is twice the
    mean of the squares of their correlations.

    Parameters
    ----------
    images : int
        Number of images; at most `_MOST_ANCHORS` of them are compared with all later ones.
    """

    def __init__(self, images: int) -> None:
        self._stride = -(-images // _MOST_ANCHORS)
        self._with_earlier = np.zeros((0, 0))
        self._count, self._repeated = 0, 0.0

    def add(self, before: State, moved: State, joint: JointFilter) -> None:
        """Add an image: the state after the last image, that before this one, and the filter."""
        predicted, after = joint.predicted, joint.state
        crossed = np.zeros((len(predicted.mean), 0))
        if self._count:
            step = _Step(before, predicted, moved.carried, _kept(joint, moved))
            crossed = _carried(step, self._with_earlier)
        left = np.isin(predicted.landmarks, after.landmarks)
        if left.all():
            corrected = after.covariance @ _solved(predicted.covariance, crossed)
        else:
            # The image was not used, and its new landmarks are left out.
            corrected = crossed[predicted.rows(left)]
        whiten = np.linalg.inv(np.linalg.cholesky(after.covariance[:3, :3]))
        self._repeated += 2.0 * self._stride * float(np.sum((whiten @ corrected[:3]) ** 2))
        self._repeated += len(whiten)
        if not self._count % self._stride:
            corrected = np.hstack([corrected, after.covariance[:, :3] @ whiten.T])
        self._with_earlier, self._count = corrected, self._count + 1

    @property
    def independent(self) -> float:
        """Number of independent errors with the same variance of the mean of squares."""
        return 3.0 * self._count**2 / self._repeated if self._count else float('nan')
