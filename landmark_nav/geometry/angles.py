"""Angles in radians, counter-clockwise positive."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ['circular_mean_rad', 'wrap_rad']


def wrap_rad(angle_rad: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """
    Wrap angles to (-pi, pi].

    Parameters
    ----------
    angle_rad : array_like, shape (...)
        Angles, radians.

    Returns
    -------
    ndarray, shape (...)

    """
    angle = np.asarray(angle_rad, dtype=np.float64)
    return np.asarray(np.pi - np.mod(np.pi - angle, 2.0 * np.pi))


def circular_mean_rad(angle_rad: npt.ArrayLike, weights: npt.ArrayLike | None = None) -> float:
    """
    Weighted circular mean of angles (n,), in (-pi, pi].

    Mardia and Jupp, Directional Statistics, 2000, eq. 2.2.4.
    """
    angle = np.asarray(angle_rad, dtype=np.float64)
    weight = np.ones_like(angle) if weights is None else np.asarray(weights, dtype=np.float64)
    return float(wrap_rad(np.angle(np.sum(weight * np.exp(1j * angle)))))
