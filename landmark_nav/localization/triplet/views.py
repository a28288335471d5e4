"""
Views that take in three landmarks, and how long the pan-tilt unit needs for them.

A landmark is seen whole while the pan is within its reach of its azimuth. Three are seen in one
view, or in several, one after the other, the way between them included.
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

    `pan_rad` (t, 3) sees each landmark of a triplet, the same one where a view holds several;
    `cost` (t,) is the time of a look and of the turn until all were in view, relative to that of
    a look: infinite where there is no way.
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
        Number of views, and the unit's speed.

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
        where one view is asked for and can't hold both.
        """
        near = np.minimum(self.upper[:, None], self.upper)
        far = np.maximum(self.lower[:, None], self.lower)
        possible = self.place[:, None] != self.place
        if self.config.views == 'one':
            possible &= far <= near
        cost = np.full(possible.shape, np.inf)
        cost[possible] = self._cost(near[possible], far[possible])
        return cost

    def tours(self, triplets: IndexArray) -> Tours:
        """Return how to see each of the triplets (t, 3)."""
        lower, upper = self.lower[triplets], self.upper[triplets]
        cost = self._cost(upper.min(axis=-1), lower.max(axis=-1))
        return Tours(self._stops(lower, upper), cost)

    def _cost(self, near: FloatArray, far: FloatArray) -> FloatArray:
        """
        Cost (...) of a turn until all windows were in view.

        Parameters
        ----------
        near, far : ndarray, shape (...)
            Least upper and greatest lower edge of the windows: in one view from `far` to `near`
            if that is not empty, else on the way from `near` to `far`.

        """
        across = np.maximum(far - near, 0.0)
        way = across
        if self.pan_rad is not None:
            first, last = np.minimum(near, far), np.maximum(near, far)
            outside = np.maximum(np.maximum(first - self.pan_rad, self.pan_rad - last), 0.0)
            ends = np.minimum(np.abs(near - self.pan_rad), np.abs(far - self.pan_rad))
            way = across + np.where(across > 0.0, ends, outside)
        if self.config.views == 'one':
            way = np.where(across > 0.0, np.inf, way)
        seconds = travel_s(way, self.config.pan_rate_rad_s, self.config.pan_acceleration_rad_s2)
        return np.asarray(1.0 + seconds / self.config.dwell_time_s)

    @staticmethod
    def _stops(lower: FloatArray, upper: FloatArray) -> FloatArray:
        """Pans (t, 3) amid windows (t, 3), one for all neighbours that can share it."""
        order = np.argsort(lower + upper, axis=-1, kind='stable')
        lower, upper = (np.take_along_axis(edge, order, -1) for edge in (lower, upper))
        pan = 0.5 * (lower + upper)
        first = np.zeros(len(pan), dtype=np.intp)  # of those that share a pan
        least, most = lower[:, 0], upper[:, 0]
        for k in (1, 2):
            shared = np.maximum(least, lower[:, k]) <= np.minimum(most, upper[:, k])
            least = np.where(shared, np.maximum(least, lower[:, k]), lower[:, k])
            most = np.where(shared, np.minimum(most, upper[:, k]), upper[:, k])
            first = np.where(shared, first, k)
            group = (np.arange(3) >= first[:, None]) & (np.arange(3) <= k)
            pan = np.where(group, 0.5 * (least + most)[:, None], pan)
        unsorted = np.empty_like(pan)
        np.put_along_axis(unsorted, order, pan, axis=-1)
        return unsorted
