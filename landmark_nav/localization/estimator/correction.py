"""
Correction of the state by an image: an iterated extended Kalman update with t-distributed noise.

Weights of the detections are iterated (Lange, Little and Taylor, JASA 84(408), 1989), and so is
the linearisation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.estimator.factors import (
    DELAY,
    FOCAL,
    ImagePoints,
    LEAST_STEP_S,
    project,
    STATES,
)
from landmark_nav.localization.estimator.integrity import found_log_ratios, squared_norms
from landmark_nav.localization.estimator.noise import DETECTION, learned
from landmark_nav.localization.estimator.state import (
    information_of,
    MapErrors,
    OUTLIER,
    State,
    Update,
)
from landmark_nav.types import FloatArray

# Iterations of an update, and the change of the pose, m and rad, that ends them: its nonlinearity
# is then a hundredth of the noise.
_ITERATIONS, _CONVERGED = 5, 3e-3
# Iterations of the weights, and the relative change that ends them.
_WEIGHINGS, _SAME_WEIGHT = 10, 0.3
# Factor on the variance of a detection that is not used.
_NO_INFORMATION = 1e6
# Significance at which an image is surprising.
_SURPRISE = 1e-3
# Tangents from here on, at 0.01 deg from 90, leave no digits for the covariance.
_MOST_TANGENT = 5e3


def usable(seen: ImagePoints, landmarks: int) -> ImagePoints:
    """Return the valid detections."""
    with np.errstate(invalid='ignore'):
        variance = np.diagonal(seen.covariance, axis1=1, axis2=2)
        good = (seen.columns >= 0) & (seen.columns < landmarks) & np.isfinite(seen.pan_rad)
        good &= (np.abs(seen.points) < _MOST_TANGENT).all(axis=1)
        good &= np.isfinite(seen.covariance).all(axis=(1, 2)) & (variance > 0.0).all(axis=1)
    columns = seen.columns.tolist()
    good &= np.array([k not in columns[:i] for i, k in enumerate(columns)], dtype=np.bool_)
    shared = np.array([seen.tilt_rad, seen.pan_rate_rad_s, seen.pan_sigma_rad])
    good &= np.isfinite(shared).all()
    return seen if good.all() else seen.chosen(good)


def corrected(
    state: State,
    seen: ImagePoints,
    errors: MapErrors,
    new: npt.NDArray[np.bool_],
    pan_sigma_rad: float,
    freedom: float,
) -> tuple[Callable[[], State], Update]:
    """
    Correct a state by the detections of an image; the new state is computed when it is called.

    Parameters
    ----------
    state : State
        Prediction, with own errors of all landmarks seen.
    errors : MapErrors
        Errors of the map.
    new : ndarray of bool, shape (m,)
        Landmarks that were not seen before: their own errors have the tail of the detections.
    pan_sigma_rad : float
        Noise of the pan joint, which all detections of an image share.
    freedom : float
        Degrees of freedom of the t distribution of detections; 0 means Gaussian.
    """
    late = float(np.sqrt(state.covariance[DELAY, DELAY]))
    seen = replace(seen, delay_step_s=max(late, LEAST_STEP_S))
    bend = seen.bend_rad(float(state.mean[DELAY])) * min(1.0, late / LEAST_STEP_S) ** 2
    rows = 2 if seen.rows else 1
    count, size = len(seen), len(state.mean)
    slots = np.empty(len(errors.positions), dtype=np.intp)
    slots[state.landmarks] = np.arange(len(state.landmarks))
    own = state.first_own + 3 * slots[seen.columns][:, None] + np.arange(3)
    on, objects = np.nonzero(errors.objects[seen.columns])
    displaced = state.displacements(objects)
    each = np.arange(count)
    prior = state.mean
    noise = state.scales.factors[DETECTION] * seen.covariance[:, :rows, :rows]
    if seen.sizes is not None:
        by_scale = state.covariance[FOCAL, FOCAL] * seen.sizes[:, :rows] ** 2 / 12.0
        noise += by_scale[:, None] * np.eye(rows)
    unseen_own = errors.own[seen.columns] * new[:, None, None]
    common = pan_sigma_rad**2 + seen.pan_sigma_rad**2 + bend**2
    # The error of the pan is estimated with the state: joint states may be far apart.
    mean, looser, pan_error = prior, np.ones(count), 0.0
    if seen.near is not None:
        mean = np.concatenate([seen.near, prior[3:]])
    for _ in range(_ITERATIONS):
        points = errors.positions[seen.columns] + mean[own]
        points += errors.loadings[seen.columns] @ mean[STATES : errors.end]
        np.add.at(points[:, :2], on, mean[displaced])
        model = project(mean, points, replace(seen, pan_rad=seen.pan_rad + pan_error))
        parts = np.zeros((count, 2, size))
        parts[:, :, :STATES] = model.by_state
        parts[:, :, STATES : errors.end] = model.by_point @ errors.loadings[seen.columns]
        parts[each[:, None], :, own] = model.by_point.swapaxes(1, 2)
        parts[on[:, None], :, displaced] = model.by_point[on, :, :2].swapaxes(1, 2)
        jacobian = parts[:, :rows].reshape(count * rows, size)
        offset = prior - mean
        offset[2] = wrap_rad(offset[2])
        by_pan = model.by_pan[:, :rows].ravel()
        innovation = (seen.points - model.points)[:, :rows].ravel() - jacobian @ offset
        innovation += by_pan * pan_error
        with_state = state.covariance @ jacobian.T
        spread = jacobian @ with_state + common * np.outer(by_pan, by_pan)
        # A landmark behind the camera has no information.
        behind = np.where(model.ahead, 0.0, _NO_INFORMATION)
        by_point = model.by_point[:, :rows]
        tailed = noise + by_point @ unseen_own @ by_point.swapaxes(1, 2)
        for _ in range(_WEIGHINGS):
            excess = tailed * (looser - 1.0 + behind)[:, None, None]
            covariance = _with_blocks(spread, noise + excess)
            precision = np.linalg.inv(covariance)
            pull = precision @ innovation
            blocks = precision.reshape(count, rows, count, rows)[each, :, each]
            others = np.linalg.inv(blocks)
            alone: FloatArray = (others @ pull.reshape(count, rows, 1))[..., 0]
            nominal = others - excess
            squares = squared_norms(alone, nominal)
            if not freedom:
                break
            before, looser = looser, np.maximum((freedom + squares) / (freedom + rows), 1.0)
            if np.abs(looser / before - 1.0).max() < _SAME_WEIGHT:
                break
        widened, square = covariance, float(innovation @ pull)
        out = looser > 1.0 / OUTLIER
        if out.any():
            # What is found elsewhere than the landmark has no information.
            behind = np.where(out, _NO_INFORMATION, behind)
            excess = tailed * (looser - 1.0 + behind)[:, None, None]
            covariance = _with_blocks(spread, noise + excess)
            precision = np.linalg.inv(covariance)
            pull = precision @ innovation
        after = prior + with_state @ pull
        after[2] = wrap_rad(after[2])
        turned = common * float(by_pan @ pull)
        change = max(np.abs(after[:3] - mean[:3]).max(), abs(turned - pan_error))
        mean, pan_error = after, turned
        if change < _CONVERGED:
            break
    _, log_determinant = np.linalg.slogdet(widened)
    evidence = -0.5 * (square + log_determinant)
    if freedom:
        # Prior density of the weights, which are gamma variables.
        evidence -= 0.5 * freedom * float(np.sum(np.log(looser) + 1.0 / looser))
    pulls = pull.reshape(count, rows, 1)
    columns = with_state[:3] @ precision
    separating = columns.reshape(3, count, rows).swapaxes(0, 1) @ others

    def after_image() -> State:
        gain = with_state @ precision
        # Joseph's form: an unknown pose leaves the gain few digits, whose errors hardly matter.
        corrected = gain @ (2.0 * with_state - gain @ covariance).T
        # In place: the covariance is larger than the cache.
        np.subtract(state.covariance, corrected, out=corrected)
        symmetric = corrected + corrected.T
        symmetric *= 0.5
        # Parts of the covariance by each noise. Errors of landmarks and map are taken as their
        # regression on the state and a rest, so that no more is by noise than there is.
        by_acted = gain[:STATES]
        acted = with_state[:STATES].T @ information_of(state.covariance[:STATES, :STATES])
        of_noise = acted @ state.by_noise @ acted.T
        detected = _with_blocks(np.zeros_like(spread), noise * looser[:, None, None])
        of_noise[DETECTION] += detected
        left = np.eye(STATES) - by_acted @ acted
        by_noise = left @ state.by_noise @ left.T
        by_noise[DETECTION] += by_acted @ detected @ by_acted.T
        return replace(
            state,
            stamp_ns=max(state.stamp_ns, seen.stamp_ns),
            mean=mean,
            covariance=symmetric,
            by_noise=by_noise,
            scales=learned(state.scales, innovation, covariance, of_noise),
        )

    return after_image, Update(
        seen.stamp_ns,
        seen.columns,
        alone,
        nominal,
        1.0 / (looser + behind),
        found_log_ratios(alone, nominal),
        float(evidence),
        bool(square > chdtri(count * rows, _SURPRISE)),
        False,
        -(separating @ pulls)[..., 0],
        separating @ columns.reshape(3, count, rows).transpose(1, 2, 0),
    )


def _with_blocks(matrix: FloatArray, blocks: FloatArray) -> FloatArray:
    """Add blocks (m, d, d) to the diagonal of a matrix (m d, m d)."""
    count, size, _ = blocks.shape
    out = np.array(matrix)
    each = np.arange(count)
    out.reshape(count, size, count, size)[each, :, each] += blocks
    return out
