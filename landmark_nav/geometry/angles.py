"""Angles in radians, counter-clockwise positive."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

__all__ = ['wrap_one_rad', 'wrap_rad']


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


def wrap_one_rad(angle_rad: float) -> float:
    """Wrap a single angle to (-pi, pi], in a small part of the time that an array takes."""
    return math.pi - (math.pi - angle_rad) % math.tau
