"""Angles in radians, counter-clockwise positive."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

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
        raise LandmarkNavError(f'{where}: the pan goes over {span:.0f} rad: are these degrees?')


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
