"""
Damped least squares for all of learning, and covariances that are positive by construction.

A step of Gauss-Newton is taken as it is where it lowers the cost; where it does not, or where it is
longer than the problem is linear, it is damped until it does (Levenberg, 1944; Marquardt, 1963).
What the data say nothing of keeps a weak prior, so that no matrix is singular.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import cho_factor, cho_solve, LinAlgError

from landmark_nav.types import FloatArray

__all__ = ['covariance_of', 'damped_step', 'levenberg_marquardt', 'solve_positive']

# Share of the diagonal that is added where a matrix is not positive by rounding, at first.
_RIDGE = 1e-14
# Damping at first, by what it grows and falls, and where a step is given up.
_FIRST, _GROWS, _FALLS, _MOST = 1e-4, 10.0, 0.1, 1e8
_ITERATIONS, _CONVERGED = 20, 1e-3


def solve_positive(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """
    Solve ``matrix x = right`` for a symmetric matrix (n, n) that is not negative, right (n, ...).

    Rows are scaled to a unit diagonal; where rounding or missing data leave it singular, as little
    as is needed is added there, which is a weak prior about 0.
    """
    diagonal = np.diag(matrix).copy()
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = matrix * np.outer(scale, scale)
    ridge = 0.0
    while True:
        try:
            factor = cho_factor(scaled + ridge * np.eye(len(scaled)), lower=True)
            break
        except LinAlgError:
            ridge = max(10.0 * ridge, _RIDGE)
    weighted = right * scale.reshape(-1, *[1] * (right.ndim - 1))
    solved = cho_solve(factor, weighted.reshape(len(scaled), -1)).reshape(right.shape)
    return np.asarray(solved * scale.reshape(-1, *[1] * (right.ndim - 1)))


def covariance_of(information: FloatArray) -> FloatArray:
    """Inverse of an information matrix (n, n), symmetric and positive by construction."""
    covariance = solve_positive(information, np.eye(len(information)))
    return np.asarray(0.5 * (covariance + covariance.T))


def damped_step(
    step_of: Callable[[float], FloatArray],
    cost_after: Callable[[FloatArray], float],
    cost: float,
    damping: float,
) -> tuple[FloatArray | None, float, float]:
    """
    Damp a step until it lowers the cost.

    Parameters
    ----------
    step_of : callable
        Step with a damping: 0 is that of Gauss-Newton.
    cost_after : callable
        Cost after a step.
    cost : float
        Cost before.
    damping : float
        To begin with.

    Returns
    -------
    step : ndarray or None
        None where nothing lowers the cost.
    cost : float
        After the step.
    damping : float
        To begin with next time.

    """
    while damping < _MOST:
        step = step_of(damping)
        after = cost_after(step)
        if after <= cost:
            return step, after, damping * _FALLS if damping > _FIRST else 0.0
        damping = max(_GROWS * damping, _FIRST)
    return None, cost, damping


def levenberg_marquardt(
    linearize: Callable[[FloatArray], tuple[FloatArray, FloatArray]], start: FloatArray
) -> tuple[FloatArray, float, FloatArray]:
    """
    Minimize a sum of squares.

    Parameters
    ----------
    linearize : callable
        Residuals (m,) in standard deviations at a state (n,), and their derivatives (m, n).
    start : ndarray, shape (n,)
        Where to begin.

    Returns
    -------
    state : ndarray, shape (n,)
    cost : float
        Sum of squares.
    information : ndarray, shape (n, n)

    """
    state, damping = start, 0.0
    residuals, jacobian = linearize(state)
    for _ in range(_ITERATIONS):
        cost = float(residuals @ residuals)
        normal, slope = jacobian.T @ jacobian, jacobian.T @ residuals
        diagonal = np.diag(np.diag(normal))

        def step_of(by: float, normal=normal, slope=slope, diagonal=diagonal) -> FloatArray:
            return -solve_positive(normal + by * diagonal, slope)

        def cost_after(step: FloatArray, state=state) -> float:
            there, _ = linearize(state + step)
            return float(there @ there)

        step, after, damping = damped_step(step_of, cost_after, cost, damping)
        if step is None:
            break
        state = state + step
        residuals, jacobian = linearize(state)
        if cost - after < _CONVERGED:
            break
    return state, float(residuals @ residuals), jacobian.T @ jacobian
