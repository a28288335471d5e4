"""The linearised measurement model of bearings, and the Kalman step."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.fusion.bearings import BearingFrame
from landmark_nav.localization.fusion.lens import straightened
from landmark_nav.localization.fusion.noise import LEARNED, SIGHTING
from landmark_nav.localization.fusion.state import BORESIGHT, DELAY, FilterState, LENS, STATES
from landmark_nav.localization.joint_delay import PanError, STILL
from landmark_nav.localization.triangulation.model import bearing_gradients, bearing_residuals
from landmark_nav.types import FloatArray

__all__ = ['MeasurementModel', 'bearing_model', 'correct', 'expected_bearings', 'refined']

_ALL = slice(None)


class MeasurementModel(NamedTuple):
    """
    A linearised measurement of m numbers: what a Kalman step needs.

    Parameters
    ----------
    innovation : ndarray, shape (m,)
        Measured minus expected at the prior.
    jacobian : ndarray, shape (m, STATES)
        Derivative of the expected measurement by the state.
    state_covariance : ndarray, shape (STATES, m)
        Covariance of the state with the innovation.
    considered_covariance : ndarray, shape (F + 3n, m)
        Covariance of the errors of the map with the innovation.
    covariance : ndarray, shape (m, m)
        Covariance of the innovation.
    by_noise : ndarray, shape (LEARNED, m, m)
        Part of it that each learned noise adds in this measurement.
    columns : ndarray of int, shape (l,)
        Landmarks that it is of.

    """

    innovation: FloatArray
    jacobian: FloatArray
    state_covariance: FloatArray
    considered_covariance: FloatArray
    covariance: FloatArray
    by_noise: FloatArray
    columns: IndexArray


def expected_bearings(
    prior: FilterState,
    frame: BearingFrame,
    lever: FloatArray,
    chosen: IndexArray | slice = _ALL,
    at: FilterState | None = None,
) -> MeasurementModel:
    """
    Return the model of a frame's bearings, all or those `chosen`, linearised at the prior or `at`.

    The error of the linearisation is accounted for to second order, by the covariance of the
    position there, unless `nonlinearity_inflation` of the frame's configuration is 0.
    """
    at = at or prior
    variance = prior.scales.factors[SIGHTING] * frame.variance[chosen]
    model = bearing_model(
        prior,
        at,
        frame.columns[chosen],
        frame.bearing_rad[chosen],
        (1.0 - frame.config.correlated_noise_fraction) * variance,
        np.sqrt(frame.config.correlated_noise_fraction * variance),
        frame.common_variance,
        lever,
        frame.lag(at.late),
        frame.pan,
    )
    if not frame.config.nonlinearity_inflation:
        return model
    bend, spread = _left_out(model.jacobian[:, :2], at.covariance[:2, :2])
    return model._replace(
        innovation=model.innovation - bend,
        # It is not independent noise: images in a row repeat it.
        covariance=model.covariance + frame.config.nonlinearity_inflation * spread,
    )


def bearing_model(
    prior: FilterState,
    at: FilterState,
    columns: IndexArray,
    bearings: FloatArray,
    variance: FloatArray,
    repeated_sigma: FloatArray,
    common_variance: float,
    lever: FloatArray,
    lag: PanError = STILL,
    pan: float = 0.0,
) -> MeasurementModel:
    """
    Return the model of bearings with the uncertainty of a prior, linearised at a state.

    Parameters
    ----------
    prior : FilterState
        State before the measurement.
    at : FilterState
        Where to linearise, with the same map; its covariances are not used.
    columns : ndarray of int, shape (m,)
        Columns of the landmarks in the map.
    bearings : ndarray, shape (m,)
        Measured bearings, radians.
    variance : ndarray, shape (m,)
        Of the independent noise of each, rad^2.
    repeated_sigma : ndarray, shape (m,)
        Of the repeated error of each landmark's detections, radians.
    common_variance : float
        Of the error that all of them share, rad^2.
    lever : ndarray, shape (2,)
        Pan axis in the base frame, metres.
    lag : PanError
        Error of the pan by late joint stamps, for the delay in the state `at`.
    pan : float
        Pan of the image, radians: an error of the principal point bends bearings about it.

    """
    x, y, heading = at.mean[:3]
    cos, sin = np.cos(heading), np.sin(heading)
    arm = np.array([cos * lever[0] - sin * lever[1], sin * lever[0] + cos * lever[1]])
    axis = np.array([x + arm[0], y + arm[1], heading])
    seen = at.map_errors.places(columns)
    straight, by_lens = straightened(bearings, pan, float(at.mean[LENS]))
    shift = at.mean[BORESIGHT] - lag.shift_rad
    residual = bearing_residuals(axis, seen, straight - shift)
    gradient = bearing_gradients(axis, seen)

    jacobian = np.zeros((len(columns), STATES))
    jacobian[:, :2] = gradient
    jacobian[:, 2] = gradient[:, 1] * arm[0] - gradient[:, 0] * arm[1] - 1.0
    jacobian[:, BORESIGHT] = 1.0
    jacobian[:, DELAY] = -lag.rate_rad_s
    jacobian[:, LENS] = -by_lens

    # By a landmark's place a bearing changes as by that of the pan axis, with the opposite sign.
    errors = prior.map_errors
    through = errors.influence(columns, gradient, repeated_sigma)
    numbers, by_errors = through.numbers, through.by_errors
    state_covariance = prior.covariance @ jacobian.T - prior.cross[:, numbers] @ by_errors.T
    # The covariance is symmetric; its rows are contiguous in memory, its columns are not.
    considered_covariance = prior.cross.T @ jacobian.T
    considered_covariance -= errors.covariance_with(through)
    by_noise = np.zeros((LEARNED, len(columns), len(columns)))
    np.fill_diagonal(by_noise[SIGHTING], variance)
    covariance = jacobian @ state_covariance - by_errors @ considered_covariance[numbers]
    covariance += by_noise[SIGHTING] + common_variance + lag.bend_rad**2

    offset = prior.mean - at.mean
    offset[2] = wrap_rad(offset[2])
    innovation = residual - jacobian @ offset
    innovation -= repeated_sigma * errors.repeated(columns)
    return MeasurementModel(
        innovation,
        jacobian,
        state_covariance,
        considered_covariance,
        covariance,
        by_noise,
        columns,
    )


def correct(prior: FilterState, model: MeasurementModel) -> FilterState:
    """
    Return the state after a Kalman step; the map stays as it is.

    With a model that is not linearised at the prior this is one step of an iterated update (Bell
    and Cathey, The Iterated Kalman Filter Update as a Gauss-Newton Method, 1993).
    """
    gain = np.linalg.solve(model.covariance, model.state_covariance.T).T
    mean = prior.mean + gain @ model.innovation
    mean[2] = wrap_rad(mean[2])
    covariance = prior.covariance - gain @ model.state_covariance.T
    left = np.eye(STATES) - gain @ model.jacobian
    return replace(
        prior,
        mean=mean,
        covariance=0.5 * (covariance + covariance.T),
        cross=prior.cross - gain @ model.considered_covariance.T,
        by_noise=left @ prior.by_noise @ left.T + gain @ model.by_noise @ gain.T,
    )


def refined(state: FilterState, model: MeasurementModel, shared: bool) -> FilterState:
    """Return the state after `correct`, with the errors of the map estimated."""
    errors = state.map_errors.refined(
        model.columns, model.considered_covariance, model.covariance, model.innovation, shared
    )
    return replace(state, map_errors=errors)


def _left_out(gradient: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """
    Mean (m,) and covariance (m, m) of the error of linearising bearings (m,), to second order.

    Positions scatter with `covariance` (2, 2) about the point of linearisation, where bearings
    have the first derivatives `gradient` (m, 2) (Garcia-Fernandez et al., Posterior Linearization
    Filter, 2015). Without it a pose known to decimetres would become certain along the arc that a
    few bearings leave open, as each image is linearised at another point of that arc.
    """
    x, y = gradient.T
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    # The second derivative of a bearing is [[a, b], [b, -a]]; a and b follow from the first one.
    second = np.stack([-2.0 * x * y, x * x - y * y], -1)
    across = 2.0 * xy * (xx - yy)
    squares = np.array(
        [[xx * xx + yy * yy - 2.0 * xy * xy, across], [across, 2.0 * (xy * xy + xx * yy)]]
    )
    mean = 0.5 * second @ np.array([xx - yy, 2.0 * xy])
    return mean, 0.5 * second @ squares @ second.T
