"""Likelihood ratio of detections: landmarks at the expected place, or matches by chance."""

from __future__ import annotations

import numpy as np

from landmark_nav.types import FloatArray

# Rates: of false detections with a right pose; of landmarks in view that are found with a right
# pose, and by chance with a wrong one.
_WRONG, _FOUND, _BY_CHANCE = 0.1, 0.8, 0.15
# Half width of the window in which chance matches are uniform: in sigmas, and at least this angle.
_WINDOW_SIGMAS, _LEAST_WINDOW = 3.0, 0.02
# Log likelihood ratio of a landmark that is not found: right pose against wrong pose.
MISSED = float(np.log((1.0 - _FOUND) / (1.0 - _BY_CHANCE)))


def squared_norms(residual: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis norms (m,) of residuals (m, d) with covariances (m, d, d)."""
    weighted = np.linalg.solve(covariance, residual[..., None])[..., 0]
    return np.asarray(np.einsum('mi,mi->m', residual, weighted))


def found_log_ratios(residual: FloatArray, covariance: FloatArray) -> FloatArray:
    """
    Log likelihood ratio (m,) of each landmark that is found: right pose against wrong pose.

    `residual` (m, d) is measured minus expected, `covariance` (m, d, d) that of each.
    """
    area = np.prod(2.0 * _windows(covariance), axis=1)
    density = np.exp(-0.5 * np.minimum(squared_norms(residual, covariance), 1e3))
    density /= np.sqrt(np.linalg.det(2.0 * np.pi * covariance))
    return np.asarray(
        np.log((1.0 - _WRONG) * density * area + _WRONG) + np.log(_FOUND / _BY_CHANCE)
    )


def chance_log_evidence(residual: FloatArray, covariance: FloatArray) -> float:
    """
    Log evidence of an image whose landmarks were all found by chance, in the widest window of all.

    As in `Update.log_evidence`, the powers of 2 pi of normal densities are left out.
    """
    half = np.maximum(_windows(covariance), np.abs(residual)).max(axis=0)
    each = np.log(_WRONG) - np.sum(np.log(2.0 * half)) + 0.5 * len(half) * np.log(2.0 * np.pi)
    return float(len(residual) * each)


def _windows(covariance: FloatArray) -> FloatArray:
    """Half sizes (m, d) of the windows for covariances (m, d, d)."""
    sigmas = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return np.maximum(_WINDOW_SIGMAS * sigmas, _LEAST_WINDOW)
