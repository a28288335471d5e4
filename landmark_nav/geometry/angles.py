"""Angles in radians, counter-clockwise positive, and a pan about a time."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray
from landmark_nav.errors import LandmarkNavError

# No pan or tilt joint turns faster.
_FASTEST_RAD_S = 10.0


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


def check_one_turn(pans_rad: npt.ArrayLike, where: str) -> None:
    """Refuse pan angles (n,) of one turn of the camera that must have been given in degrees."""
    span = float(np.ptp(pans_rad))
    if span > 4.0 * np.pi:
        raise LandmarkNavError(
            f'{where}: the pan goes over {span:.0f} rad: are these degrees or ticks?'
        )


def unwrap_joint(stamps_ns: npt.ArrayLike, angles_rad: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """
    Angles of a joint without the jumps of a driver that reports it within +-pi.

    A step of more than half a turn is a jump where no joint turns as fast; one that counts its
    turns has none.

    Parameters
    ----------
    stamps_ns : array_like, shape (k,)
        Their times, ascending or descending.
    angles_rad : array_like, shape (k,)
        Measured angles, radians.

    Returns
    -------
    ndarray, shape (k,)
        The first as it was measured, the others whole turns off at most.
    """
    angles = np.array(angles_rad, dtype=np.float64)
    steps = np.diff(angles)
    seconds = 1e-9 * np.abs(np.diff(np.asarray(stamps_ns, dtype=np.int64)))
    jumps = np.abs(steps) > np.maximum(np.pi, _FASTEST_RAD_S * seconds)
    turns = np.where(jumps, np.rint(steps / (2.0 * np.pi)), 0.0)
    angles[1:] -= 2.0 * np.pi * np.cumsum(turns)
    return angles


# Gauss-Hermite nodes of a standard normal variable, and their weights.
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
_WEIGHTS /= _WEIGHTS.sum()


class LaggedPan(NamedTuple):
    """
    Pan at an uncertain time: its value, derivative, and standard deviation about that line.

    Statistical linearization: slope and deviation are those over the distribution of the time
    (Gelb, Applied Optimal Estimation, 1974, section 6.2), as a pan may begin or cease to turn
    within it.
    """

    pan_rad: float
    rate_rad_s: float
    bend_rad: float


@dataclass(frozen=True, eq=False)
class PanTrack:
    """Pan `pans_rad` (k,) at times `seconds` (k,), ascending, after some moment."""

    seconds: FloatArray
    pans_rad: FloatArray

    def at(self, seconds: npt.ArrayLike) -> FloatArray:
        """Pan at times (m,); beyond the first and the last it stays."""
        times = np.asarray(seconds, dtype=np.float64)
        return np.interp(times, self.seconds, self.pans_rad)

    def lagged(self, seconds: float, sigma_s: float) -> LaggedPan:
        """Pan at a time that is known with a standard deviation."""
        offsets = sigma_s * _NODES
        pan, *pans = self.at([seconds, *(seconds + offsets)]).tolist()
        moved = np.array(pans) - pan
        rate = float(_WEIGHTS @ (moved * _NODES)) / sigma_s
        return LaggedPan(pan, rate, float(np.sqrt(_WEIGHTS @ (moved - rate * offsets) ** 2)))
