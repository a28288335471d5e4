"""Angles in radians, positive counter-clockwise, and the pan as a function of time."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray
from landmark_nav.errors import LandmarkNavError

# Bound of the rate of any pan or tilt joint.
_MAX_RATE_RAD_S = 10.0


def wrap_rad(angle_rad: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Wrap angles (...), radians, to (-pi, pi]."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    return np.asarray(np.pi - np.mod(np.pi - angle, 2.0 * np.pi))


def wrap_one_rad(angle_rad: float) -> float:
    """Wrap a single angle to (-pi, pi]; much faster than `wrap_rad`."""
    return math.pi - (math.pi - angle_rad) % math.tau


def check_one_turn(pans_rad: npt.ArrayLike, where: str) -> None:
    """Raise `LandmarkNavError` if pan angles (n,) of one turn seem to be in degrees."""
    span = float(np.ptp(pans_rad))
    if span > 4.0 * np.pi:
        raise LandmarkNavError(
            f'{where}: the pan goes over {span:.0f} rad: are these degrees or ticks?'
        )


def unwrap_joint(stamps_ns: npt.ArrayLike, angles_rad: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """
    Remove the jumps of a driver that reports the angle of a joint within +-pi.

    A step of more than half a turn is a jump if it is faster than any joint. The angles of a
    driver that counts turns do not change.

    Parameters
    ----------
    stamps_ns : array_like, shape (k,)
        Times of the angles, ascending or descending.
    angles_rad : array_like, shape (k,)
        Measured angles, radians.

    Returns
    -------
    ndarray, shape (k,)
        Angles that differ from the measured ones by whole turns; the first is unchanged.
    """
    angles = np.array(angles_rad, dtype=np.float64)
    steps = np.diff(angles)
    seconds = 1e-9 * np.abs(np.diff(np.asarray(stamps_ns, dtype=np.int64)))
    jumps = np.abs(steps) > np.maximum(np.pi, _MAX_RATE_RAD_S * seconds)
    turns = np.where(jumps, np.rint(steps / (2.0 * np.pi)), 0.0)
    angles[1:] -= 2.0 * np.pi * np.cumsum(turns)
    return angles


def without_turns(angle_rad: float) -> float:
    """Angle of a joint without the whole turns that it counts beyond any limit of a joint."""
    turns = round(angle_rad / (2.0 * np.pi)) if abs(angle_rad) > 2.0 * np.pi else 0
    return angle_rad - 2.0 * np.pi * turns


# Gauss-Hermite nodes of a standard normal variable, and their weights.
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
_WEIGHTS /= _WEIGHTS.sum()


@dataclass(frozen=True, eq=False)
class PanTrack:
    """Pan `pans_rad` (k,) at ascending times `seconds` (k,), relative to a reference time."""

    seconds: FloatArray
    pans_rad: FloatArray

    def at(self, seconds: npt.ArrayLike) -> FloatArray:
        """Pan at times (m,), interpolated; constant beyond the first and the last sample."""
        times = np.asarray(seconds, dtype=np.float64)
        return np.interp(times, self.seconds, self.pans_rad)

    def lagged(self, seconds: float, sigma_s: float) -> tuple[float, float]:
        """
        Rate of the pan at a time with a standard deviation, and deviation from that line, rad.

        Statistical linearization (Gelb, Applied Optimal Estimation, 1974, section 6.2): both are
        averages over the distribution of the time, as the joint may start or stop within it.
        """
        offsets = sigma_s * _NODES
        pan, *pans = self.at([seconds, *(seconds + offsets)]).tolist()
        moved = np.array(pans) - pan
        rate = float(_WEIGHTS @ (moved * _NODES)) / sigma_s
        return rate, float(np.sqrt(_WEIGHTS @ (moved - rate * offsets) ** 2))
