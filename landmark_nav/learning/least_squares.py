"""
Damped least squares for all of learning, and covariances that are positive by construction.

A step of Gauss-Newton is taken as it is where it lowers the cost; where it does not, it is damped
until it does (Levenberg, 1944; Marquardt, 1963). Where data say nothing, as little is added to the
diagonal as a Cholesky factor needs, which is a weak prior: no matrix is singular.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import solve_triangular

from landmark_nav.errors import LandmarkNavError
from landmark_nav.types import FloatArray

# Share of the diagonal that is added where a matrix is not positive by rounding, at first.
_RIDGE = 1e-14
# Damping at first, by what it grows and falls, and where a step is given up.
_FIRST, _GROWS, _FALLS, _MOST = 1e-4, 10.0, 0.1, 1e8
# A cost that is the same but for rounding has not grown.
_ROUNDING = 1e-9
_ITERATIONS, _CONVERGED = 20, 1e-3


def root_of(matrix: FloatArray) -> FloatArray:
    """
    Lower triangular root L (n, n) of a symmetric matrix (n, n) that is not negative: ``L L^T``.

    Raises `LandmarkNavError`: values that are not numbers.
    """
    if not np.isfinite(matrix).all():
        raise LandmarkNavError('the sweeps do not determine an adjustment: take them again')
    diagonal = np.diag(matrix)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = matrix / np.outer(scale, scale)
    ridge = 0.0
    while True:
        try:
            root = np.linalg.cholesky(scaled + ridge * np.eye(len(scaled)))
        except np.linalg.LinAlgError:
            ridge = max(_GROWS * ridge, _RIDGE)
        else:
            return np.asarray(scale[:, None] * root)


def solve_positive(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve ``matrix x = right`` (n, ...) for a matrix (n, n) as in `root_of`."""
    root = root_of(matrix)
    half = solve_triangular(root, right.reshape(len(root), -1), lower=True)
    return np.asarray(solve_triangular(root, half, lower=True, trans='T').reshape(right.shape))


def covariance_of(information: FloatArray) -> FloatArray:
    """Inverse of an information matrix (n, n), symmetric and positive by construction."""
    half = solve_triangular(root_of(information), np.eye(len(information)), lower=True)
    return np.asarray(half.T @ half)


def checked_covariance(covariance: FloatArray, most_sigma: FloatArray, what: str) -> FloatArray:
    """
    Covariance (n, n) that was given, made symmetric.

    Raises `LandmarkNavError`: values that are not numbers, variances that are negative or too
    large.

    Parameters
    ----------
    covariance : ndarray, shape (n, n)
        As it came.
    most_sigma : ndarray, shape (n,)
        Standard deviations beyond which it is of no use.
    what : str
        Whose it is, to begin the message with.
    """
    even = 0.5 * (covariance + covariance.T)
    if not np.isfinite(even).all():
        raise LandmarkNavError(f'{what} has a covariance that is not a number: mend its publisher')
    variance = np.diag(even)
    if (variance > most_sigma**2).any():
        listed = ', '.join(f'{s:.3g}' for s in np.sqrt(np.maximum(variance, 0.0)))
        raise LandmarkNavError(
            f'{what} has standard deviations of {listed} (m, rad), too large to learn from: give '
            'a better pose, or none'
        )
    least = float(np.linalg.eigvalsh(even)[0])
    if least < -_ROUNDING * float(np.sum(np.abs(variance))):
        raise LandmarkNavError(f'{what} has a negative variance, {least:.3g}: mend its publisher')
    return np.asarray(even)


class Damping:
    """Damping of the steps of one problem: none as long as each lowers the cost."""

    def __init__(self) -> None:
        self._by = 0.0

    def lowers(self, cost_with: Callable[[float], float], cost: float) -> bool:
        """
        Damp a step until it lowers the cost.

        Parameters
        ----------
        cost_with : callable
            Takes a step with a damping, which is a share of the diagonal of the normal equations,
            and returns the cost after it. The last step that it took is the one to keep.

        Returns
        -------
        bool
            False where no step does.
        """
        while self._by < _MOST:
            if cost_with(self._by) <= cost * (1.0 + _ROUNDING) + _ROUNDING:
                self._by = _FALLS * self._by if self._by > _FIRST else 0.0
                return True
            self._by = max(_GROWS * self._by, _FIRST)
        return False


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
    damping = Damping()
    state, here = start, linearize(start)
    for _ in range(_ITERATIONS):
        cost = float(here[0] @ here[0])
        tried, there = _tried(linearize, state, here, damping)
        if there is None:
            break
        state, here = tried, there
        if cost - here[0] @ here[0] < _CONVERGED:
            break
    residuals, jacobian = here
    return state, float(residuals @ residuals), jacobian.T @ jacobian


def _tried(
    linearize: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    state: FloatArray,
    here: tuple[FloatArray, FloatArray],
    damping: Damping,
) -> tuple[FloatArray, tuple[FloatArray, FloatArray] | None]:
    """The next state, and what `linearize` gives there; None where no step lowers the cost."""
    residuals, jacobian = here
    normal, slope = jacobian.T @ jacobian, jacobian.T @ residuals
    tried, there = state, here

    def cost_with(by: float) -> float:
        nonlocal tried, there
        tried = state - solve_positive(normal + by * np.diag(np.diag(normal)), slope)
        there = linearize(tried)
        return float(there[0] @ there[0])

    lower = damping.lowers(cost_with, float(residuals @ residuals))
    return tried, there if lower else None
