"""
The Schmidt-Kalman state and its two steps, as pure functions.

Schmidt, Application of State-Space Methods to Navigation Problems, 1966: landmarks are consider
states. Their errors and their correlations with the pose are carried along, but their places are
not estimated, so repeated sightings never claim more than the map knows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import compose, compose_jacobians
from landmark_nav.localization.odometry_noise import (
    Motion,
    motion_covariance,
    OdometryNoiseConfig,
)
from landmark_nav.localization.triangulation_model import bearing_gradients
from landmark_nav.types import FloatArray, PoseEstimate

__all__ = [
    'STATES',
    'FilterState',
    'MeasurementModel',
    'bearing_model',
    'correct',
    'initial_state',
    'pose_model',
    'propagate',
]

IndexArray = npt.NDArray[np.intp]

# x, y, heading; scale of the way, drift per metre, scale of turns; boresight of the camera.
STATES = 7
_SCALE, _DRIFT, _TURN_SCALE, _BORESIGHT = 3, 4, 5, 6


@dataclass(frozen=True, eq=False)
class FilterState:
    """
    What the filter knows at one time; never changed in place.

    Parameters
    ----------
    stamp_ns : int
        Time.
    mean : ndarray, shape (STATES,)
        Pose of the base in map and the systematic errors.
    covariance : ndarray, shape (STATES, STATES)
        Of `mean`.
    cross : ndarray, shape (STATES, 2n)
        Covariance of `mean` with the landmarks' (x, y).

    """

    stamp_ns: int
    mean: FloatArray
    covariance: FloatArray
    cross: FloatArray

    def estimate(self) -> PoseEstimate:
        """Return the pose alone."""
        return PoseEstimate(self.stamp_ns, self.mean[:3].copy(), self.covariance[:3, :3].copy())


class MeasurementModel(NamedTuple):
    """
    A linearised measurement of m numbers: residuals and the products a Kalman step needs.

    `residual` (m,), `jacobian` (m, STATES), `state_covariance` (STATES, m) of the state with what
    is expected, `map_covariance` (2n, m) of the landmarks with it, and its own covariance
    `innovation` (m, m) with the measurement noise.
    """

    residual: FloatArray
    jacobian: FloatArray
    state_covariance: FloatArray
    map_covariance: FloatArray
    innovation: FloatArray


def initial_state(
    start: PoseEstimate, landmarks: int, odometry: OdometryNoiseConfig, boresight_sigma: float
) -> FilterState:
    """Return the state at a given pose, independent of the map."""
    covariance = np.zeros((STATES, STATES))
    covariance[:3, :3] = start.covariance
    covariance[range(3, 6), range(3, 6)] = odometry.bias_sigmas**2
    covariance[_BORESIGHT, _BORESIGHT] = boresight_sigma**2
    mean = np.zeros(STATES)
    mean[:3] = start.pose
    return FilterState(start.stamp_ns, mean, covariance, np.zeros((STATES, 2 * landmarks)))


def propagate(
    state: FilterState, stamp_ns: int, motion: Motion, config: OdometryNoiseConfig
) -> FilterState:
    """Move on by odometry, corrected by what is known of its systematic errors."""
    forward, left, turn = motion.increment
    scale = 1.0 + state.mean[_SCALE]
    corrected = np.array(
        [
            scale * forward,
            scale * left,
            (1.0 + state.mean[_TURN_SCALE]) * turn + state.mean[_DRIFT] * forward,
        ]
    )
    by_pose, by_motion = compose_jacobians(state.mean[:3], corrected)
    step = np.eye(STATES)
    step[:3, :3] = by_pose
    step[:2, _SCALE] = by_motion[:2, 0] * forward + by_motion[:2, 1] * left
    step[2, _DRIFT], step[2, _TURN_SCALE] = forward, turn

    mean = state.mean.copy()
    mean[:3] = compose(state.mean[:3], corrected)
    covariance = step @ state.covariance @ step.T
    covariance[:3, :3] += (by_motion * motion_covariance(motion, config)) @ by_motion.T
    wander = (config.bias_change_per_sqrt_m * config.bias_sigmas) ** 2
    covariance[range(3, 6), range(3, 6)] += wander * np.hypot(forward, left)
    return FilterState(stamp_ns, mean, covariance, step @ state.cross)


def bearing_model(
    state: FilterState,
    columns: IndexArray,
    bearings: FloatArray,
    noise: FloatArray,
    landmarks: FloatArray,
    landmark_covariance: FloatArray,
    lever: FloatArray,
) -> MeasurementModel:
    """
    Linearise bearings about a state.

    Parameters
    ----------
    state : FilterState
        Where.
    columns : ndarray of int, shape (m,)
        Which landmarks.
    bearings : ndarray, shape (m,)
        What was measured, radians.
    noise : ndarray, shape (m, m)
        Measurement covariance, rad^2.
    landmarks, landmark_covariance : ndarray, shape (n, 2), (2n, 2n)
        The map.
    lever : ndarray, shape (2,)
        Pan axis in the base frame, metres.

    """
    x, y, heading = state.mean[:3]
    cos, sin = np.cos(heading), np.sin(heading)
    arm = np.array([cos * lever[0] - sin * lever[1], sin * lever[0] + cos * lever[1]])
    axis = np.array([x + arm[0], y + arm[1], heading])
    seen = landmarks[columns]
    delta = seen - axis[:2]
    azimuth = np.arctan2(delta[:, 1], delta[:, 0])
    residual = wrap_rad(bearings - azimuth + heading - state.mean[_BORESIGHT])
    gradient = bearing_gradients(axis, seen)

    jacobian = np.zeros((len(columns), STATES))
    jacobian[:, :2] = gradient
    jacobian[:, 2] = gradient[:, 1] * arm[0] - gradient[:, 0] * arm[1] - 1.0
    jacobian[:, _BORESIGHT] = 1.0

    # The derivative by a landmark's x and y is minus the one by the axis'.
    pair = np.stack([2 * columns, 2 * columns + 1], -1)
    state_covariance = state.covariance @ jacobian.T
    state_covariance -= np.einsum('smi,mi->sm', state.cross[:, pair], gradient)
    map_covariance = state.cross.T @ jacobian.T
    map_covariance -= np.einsum('cmi,mi->cm', landmark_covariance[:, pair], gradient)
    innovation = jacobian @ state_covariance + noise
    innovation -= np.einsum('mi,mij->mj', gradient, map_covariance[pair])
    return MeasurementModel(residual, jacobian, state_covariance, map_covariance, innovation)


def pose_model(state: FilterState, measured: PoseEstimate) -> MeasurementModel:
    """Linearise a measured pose of the base about a state."""
    residual = measured.pose - state.mean[:3]
    residual[2] = wrap_rad(residual[2])
    return MeasurementModel(
        residual,
        np.eye(3, STATES),
        state.covariance[:, :3],
        state.cross[:3].T,
        state.covariance[:3, :3] + measured.covariance,
    )


def correct(state: FilterState, model: MeasurementModel, prior: FilterState) -> FilterState:
    """
    One Gauss-Newton step of the update of `prior` with a model linearised at `state`.

    Bell and Cathey, The Iterated Kalman Filter Update as a Gauss-Newton Method, 1993.
    """
    gain = np.linalg.solve(model.innovation, model.state_covariance.T).T
    offset = prior.mean - state.mean
    offset[2] = wrap_rad(offset[2])
    mean = prior.mean + gain @ (model.residual - model.jacobian @ offset)
    mean[2] = wrap_rad(mean[2])
    covariance = prior.covariance - gain @ model.state_covariance.T
    covariance = 0.5 * (covariance + covariance.T)
    return FilterState(
        prior.stamp_ns, mean, covariance, prior.cross - gain @ model.map_covariance.T
    )
