"""
White noise of the poses of odometry: what one sample adds, the next takes back.

That of scan matchers and visual odometry, which measure a pose each time; wheels add increments.
Of four increments in a row, the differences of the inner and of the outer two have the covariance
-2 v, with v the variance of a pose. White noise of the increments adds nothing to it, and a steady
acceleration makes it positive. A robot that shakes faster than samples show jitters, too.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from landmark_nav.types import FloatArray

__all__ = ['Jitter']

_IN_A_ROW = 4
# Mean of about so many; it counts if it is beyond so many of its own sigmas,
_SAMPLES, _SIGNIFICANT = 200, 3.0
# and larger than this, metres and radians: other noise of the odometry covers less.
_LEAST = (1e-3, 1e-3)


class Jitter:
    """
    Running estimate from increments as they come.

    Attributes
    ----------
    variances : tuple of float
        Of a position on an axis [m^2] and of a heading [rad^2]; zero if too small to see.

    """

    def __init__(self) -> None:
        self.variances = (0.0, 0.0)
        self._last: deque[tuple[float, ...]] = deque(maxlen=_IN_A_ROW)
        self._count = 0
        self._mean, self._square = np.zeros(2), np.zeros(2)

    def interrupt(self) -> None:
        """The next increment does not go on from the last."""
        self._last.clear()

    def add(self, increment: FloatArray, seconds: float) -> None:
        """Take an increment (3,), forward, left [m] and turn [rad], over some time."""
        self._last.append((seconds, *(part / seconds for part in increment.tolist())))
        if len(self._last) < _IN_A_ROW:
            return
        times, *rates = zip(*self._last, strict=True)
        scale = -0.5 * (sum(times) / _IN_A_ROW) ** 2
        ahead, aside, turned = (scale * (c - b) * (d - a) for a, b, c, d in rates)
        found = np.array([0.5 * (ahead + aside), turned])
        self._count = min(self._count + 1, _SAMPLES)
        self._mean += (found - self._mean) / self._count
        self._square += (found**2 - self._square) / self._count
        sigma = np.sqrt(self._square / self._count)
        counts = (self._mean > _SIGNIFICANT * sigma) & (self._mean > np.square(_LEAST))
        position, heading = np.where(counts, self._mean, 0.0).tolist()
        self.variances = position, heading
