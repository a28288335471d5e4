"""
The prior that most walls are at right angles.

Walls at other angles are its outliers (Coughlan and Yuille, Manhattan World, ICCV 1999).
"""

from __future__ import annotations

import numpy as np

from landmark_nav.types import FloatArray

# Sigma of the angles of walls about multiples of a right angle, rad.
_RIGHT_RAD = 0.003
_STEPS = 10
# Scale of the robust weight, in sigmas.
_TAIL_WIDTH = 2.0


def common_direction(angle_rad: FloatArray, variance: FloatArray, length_m: FloatArray) -> float:
    """Direction to which most walls are at right angles, by those of n walls and their lengths."""

    def support(direction: float) -> float:
        return float(length_m @ _weights(from_right(angle_rad - direction), variance))

    common = float(max(angle_rad, key=support))
    for _ in range(_STEPS):
        off = from_right(angle_rad - common)
        weight = _weights(off, variance) / (variance + _RIGHT_RAD**2)
        common += float(np.sum(weight * off) / np.sum(weight))
    return common


def pull(angle_rad: FloatArray, variance: FloatArray, common_rad: float) -> FloatArray:
    """Residuals (n,) of the prior, divided by their variances: what they move is subtracted."""
    off = from_right(angle_rad - common_rad)
    return np.asarray(_weights(off, variance) * off / (variance + _RIGHT_RAD**2))


def from_right(angle_rad: FloatArray) -> FloatArray:
    """Difference of angles from the nearest multiple of a right angle."""
    return np.asarray((angle_rad + 0.25 * np.pi) % (0.5 * np.pi) - 0.25 * np.pi)


def _weights(off_rad: FloatArray, variance: FloatArray) -> FloatArray:
    """Weights (n,) of Geman and McClure for angles that are off by so much."""
    return np.asarray((1.0 + off_rad**2 / (_TAIL_WIDTH**2 * (variance + _RIGHT_RAD**2))) ** -2.0)
