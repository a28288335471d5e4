"""
Views that take in three landmarks, and how long the pan-tilt unit needs to turn to them.

A landmark is seen whole while the pan is within its reach of its azimuth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IndexArray
from landmark_nav.localization.triplet.visibility import TripletConfig
from landmark_nav.types import FloatArray

__all__ = ['PanWindows', 'Tours', 'travel_s']


_TURN = 2.0 * np.pi


class Tours(NamedTuple):
    """
    How triplets (t,) are looked at.

    `pan_rad` (t,) sees all three; `cost` (t,) is the time of a look and of the turn to it,
    relative to that of a look: infinite where no view holds them.
    """

    pan_rad: FloatArray
    cost: FloatArray


def travel_s(way_rad: npt.ArrayLike, rate_rad_s: float, acceleration_rad_s2: float) -> FloatArray:
    """Time of a turn (...): speeding up, at the full rate, slowing down."""
    way = np.maximum(np.asarray(way_rad, dtype=np.float64), 0.0)
    ramps = rate_rad_s**2 / acceleration_rad_s2
    short = 2.0 * np.sqrt(np.minimum(way, ramps) / acceleration_rad_s2)
    return np.asarray(short + np.maximum(way - ramps, 0.0) / rate_rad_s)


@dataclass(frozen=True, eq=False)
class PanWindows:
    """
    Pans that see landmarks whole, m of them: one for each turn of the axis that sees one.

    Parameters
    ----------
    place : ndarray of int, shape (m,)
        Which landmark each belongs to.
    lower, upper : ndarray, shape (m,)
        Least and greatest pan.
    pan_rad : float or None
        Where the camera looks now, if that is to count.
    config : TripletConfig
        The unit's speed.

    """

    place: IndexArray
    lower: FloatArray
    upper: FloatArray
    pan_rad: float | None
    config: TripletConfig

    @classmethod
    def around(
        cls,
        azimuth_rad: FloatArray,
        reach_rad: FloatArray,
        limits_rad: tuple[float, float],
        pan_rad: float | None,
        config: TripletConfig,
    ) -> PanWindows:
        """
        Windows of n landmarks, within the limits of the joint.

        Parameters
        ----------
        azimuth_rad : ndarray, shape (n,)
            Of the landmarks, in the frame of the pan axis, within (-pi, pi].
        reach_rad : ndarray, shape (n,)
            How far the pan may be off a landmark's azimuth and still hold it whole.
        limits_rad : tuple of float
            Least and greatest pan.
        pan_rad, config
            As above.

        """
        first, last = (round(limit / _TURN) for limit in limits_rad)
        turns = _TURN * np.arange(first - 1, last + 2)[:, None]
        lower = np.maximum(azimuth_rad + turns - reach_rad, limits_rad[0])
        upper = np.minimum(azimuth_rad + turns + reach_rad, limits_rad[1])
        turn, place = np.nonzero(lower <= upper)
        return cls(place, lower[turn, place], upper[turn, place], pan_rad, config)

    def costs(self) -> FloatArray:
        """
        Cost (m, m) of looking at two, relative to one look without a turn.

        A triplet costs the most of its pairs. Infinite for windows of the same landmark, and
        where no view holds both.
        """
        near = np.minimum(self.upper[:, None], self.upper)
        far = np.maximum(self.lower[:, None], self.lower)
        return np.where(self.place[:, None] != self.place, self._cost(near, far), np.inf)

    def tours(self, triplets: IndexArray) -> Tours:
        """Return how to see each of the triplets (t, 3)."""
        near, far = self.upper[triplets].min(axis=-1), self.lower[triplets].max(axis=-1)
        return Tours(0.5 * (far + near), self._cost(near, far))

    def _cost(self, near: FloatArray, far: FloatArray) -> FloatArray:
        """Cost (...) of a turn to where windows overlap, `far` to `near`; infinite: nowhere."""
        way = np.zeros_like(near)
        if self.pan_rad is not None:
            way = np.maximum(far - self.pan_rad, self.pan_rad - near)
        seconds = travel_s(way, self.config.pan_rate_rad_s, self.config.pan_acceleration_rad_s2)
        return np.where(far <= near, 1.0 + seconds / self.config.dwell_time_s, np.inf)
