"""Whether the robot stays where it is while a sweep is taken."""

from __future__ import annotations

import numpy as np

from landmark_nav.geometry import se2
from landmark_nav.types import OdometrySample

__all__ = ['Place']

# Way and turn by odometry that end a sweep, m and rad: chosen by hand.
_MOVED_M, _MOVED_RAD = 0.01, 0.01


class Place:
    """Where the frames so far were taken, by odometry; without any the robot stands."""

    def __init__(self) -> None:
        self._first: OdometrySample | None = None
        self._last: OdometrySample | None = None

    def add(self, sample: OdometrySample, *, anew: bool) -> None:
        """Take the robot's pose; `anew` says that there is no frame yet."""
        self._last = sample
        if anew or self._first is None:
            self._first = sample

    @property
    def known(self) -> bool:
        """Whether odometry shows it."""
        return self._last is not None

    @property
    def moved(self) -> str:
        """How far it has gone in words; nothing if it stands."""
        if self._first is None or self._last is None:
            return ''
        way = se2.relative(self._first.pose_odom_base, self._last.pose_odom_base)
        way_m, turn_rad = float(np.hypot(way[0], way[1])), abs(float(way[2]))
        if way_m <= _MOVED_M and turn_rad <= _MOVED_RAD:
            return ''
        return f'{100.0 * way_m:.1f} cm and {np.degrees(turn_rad):.1f} deg'
