"""Where the camera looked over some time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray

__all__ = ['PanTrack']


@dataclass(frozen=True, eq=False)
class PanTrack:
    """Pan `pans_rad` (k,) at times `seconds` (k,), ascending, after some moment."""

    seconds: FloatArray
    pans_rad: FloatArray

    def at(self, seconds: npt.ArrayLike) -> FloatArray:
        """Pan at times (m,); beyond the first and the last it stays."""
        times = np.asarray(seconds, dtype=np.float64)
        return np.interp(times, self.seconds, self.pans_rad)
