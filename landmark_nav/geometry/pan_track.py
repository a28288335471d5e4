"""Where the camera looked over some time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray

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
