"""
Damped least squares, and covariances that are positive by construction.

A Gauss-Newton step is used undamped if it lowers the cost, else with increasing damping
(Levenberg, 1944; Marquardt, 1963). If data do not determine all values, the smallest ridge that
the Cholesky factorisation needs is added to the diagonal: a weak prior, so that no matrix is
singular.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from scipy.linalg.lapack import dtrtrs

from landmark_nav.errors import LandmarkNavError
from landmark_nav.types import FloatArray

T = TypeVar('T')

# First ridge, relative to the diagonal.
_RIDGE = 1e-14
# First damping, factors of its growth and decay, and the damping at which no step is found.
_FIRST_DAMPING, _GROWTH, _DECAY, _MAX_DAMPING = 1e-4, 10.0, 0.1, 1e8
# Relative tolerance for rounding when costs are compared, and decrease that ends the iteration.
_ROUNDING, _SAME_COST = 1e-9, 1e-6


def root_of(matrix: FloatArray) -> FloatArray:
    """
    Cholesky factor L (n, n), lower triangular, of a positive semidefinite matrix (n, n).

    Raises `LandmarkNavError`: a value is not finite.
    """
    _check_finite(matrix)
    diagonal = np.diag(matrix)
    scale = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = matrix / np.outer(scale, scale)
    ridge = 0.0
    while True:
        try:
            root = np.linalg.cholesky(scaled + ridge * np.eye(len(scaled)))
        except np.linalg.LinAlgError:
            ridge = max(_GROWTH * ridge, _RIDGE)
        else:
            return np.asarray(scale[:, None] * root)


def solve_root(root: FloatArray, right: FloatArray, transposed: bool = False) -> FloatArray:
    """Solve ``L x = right`` (n, m) for a factor L (n, n) of `root_of`; or ``L^T x = right``."""
    _check_finite(right)
    # `scipy.linalg.solve_triangular` calls the same, and takes much longer for small matrices.
    return np.asarray(dtrtrs(root.T, right, lower=0, trans=not transposed)[0])


def _check_finite(matrix: FloatArray) -> None:
    if not np.isfinite(matrix).all():
        raise LandmarkNavError('the sweeps do not determine an adjustment: take them again')


def solve_positive(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve ``matrix x = right`` (n, ...) for a positive semidefinite matrix (n, n)."""
    root = root_of(matrix)
    half = solve_root(root, right.reshape(len(root), -1))
    return solve_root(root, half, transposed=True).reshape(right.shape)


def covariance_of(information: FloatArray) -> FloatArray:
    """Inverse of an information matrix (n, n), symmetric and positive by construction."""
    half = solve_root(root_of(information), np.eye(len(information)))
    return np.asarray(half.T @ half)


def checked_covariance(covariance: FloatArray, most_sigma: FloatArray, what: str) -> FloatArray:
    """
    Check a given covariance (n, n) of `what`, and return it symmetric.

    Raises `LandmarkNavError`: values are not numbers, or variances are negative or larger than
    those of the standard deviations `most_sigma` (n,).
    """
    even = 0.5 * (covariance + covariance.T)
    if not np.isfinite(even).all():
        raise LandmarkNavError(f'{what} has a covariance that is not a number: fix its publisher')
    variance = np.diag(even)
    if (variance > most_sigma**2).any():
        listed = ', '.join(f'{s:.3g}' for s in np.sqrt(np.maximum(variance, 0.0)))
        raise LandmarkNavError(
            f'{what} has standard deviations of {listed} (m, rad), too large to learn from: give '
            'a better pose, or none'
        )
    least = float(np.linalg.eigvalsh(even)[0])
    if least < -_ROUNDING * float(np.sum(np.abs(variance))):
        raise LandmarkNavError(f'{what} has a negative variance, {least:.3g}: fix its publisher')
    return np.asarray(even)


class Damping:
    """Damping of the steps of one problem; zero while undamped steps lower the cost."""

    def __init__(self) -> None:
        self._damping = 0.0

    def step(self, start: T, stepped: Callable[[float], T], cost: Callable[[T], float]) -> T:
        """
        State after a step from `start` that does not raise the cost; `start` if there is none.

        `stepped` makes a step with a damping relative to the diagonal of the normal equations.
        """
        most = cost(start) * (1.0 + _ROUNDING) + _ROUNDING
        while self._damping < _MAX_DAMPING:
            there = stepped(self._damping)
            if cost(there) <= most:
                self._damping = _DECAY * self._damping if self._damping > _FIRST_DAMPING else 0.0
                return there
            self._damping = max(_GROWTH * self._damping, _FIRST_DAMPING)
        return start


# Cost, half of its gradient (n,), and information matrix (n, n) of a linearized problem.
Equations = tuple[float, FloatArray, FloatArray]


def levenberg_marquardt(
    equations: Callable[[FloatArray], Equations], start: FloatArray
) -> tuple[FloatArray, float, FloatArray]:
    """
    Minimize a sum of squares whose normal equations at a state (n,) are `equations`.

    Returns
    -------
    state : ndarray, shape (n,)
    cost : float
    information : ndarray, shape (n, n)
    """
    damping, here = Damping(), (start, *equations(start))

    def stepped(by: float) -> tuple[FloatArray, float, FloatArray, FloatArray]:
        state, _, pull, information = here
        damped = information + by * np.diag(np.diag(information))
        there = state - solve_positive(damped, pull)
        return there, *equations(there)

    while True:
        before, here = here, damping.step(here, stepped, lambda at: at[1])
        if here is before or before[1] - here[1] <= _SAME_COST * here[1] + _ROUNDING:
            return here[0], here[1], here[3]
