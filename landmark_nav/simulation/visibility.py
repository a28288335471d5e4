"""Order in which upright things are painted so that the nearer covers the farther."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.types import FloatArray

_WIDEST_VIEW_RAD = np.radians(80.0)

# Corners are kept in arrays of four: the two ends of a wall twice.
_FOUR = np.arange(4)


class PainterOrder:
    """
    Back-to-front order of upright prisms, by lines that separate their footprints.

    Two convex footprints that do not overlap have a line between them that runs along a side of
    one of them. What lies on the viewer's side of it can cover the other and is never covered by
    it. Where two are seen in the same direction that says which is painted first; among convex
    things in less than half a turn this never goes in circles. Newell, Newell and Sancha, A
    solution to the hidden surface problem, ACM 1972, is the general case.

    Parameters
    ----------
    footprints : sequence of ndarray, shape (k, 2)
        Convex, counter-clockwise; two points make a wall.

    """

    def __init__(self, footprints: Sequence[FloatArray]) -> None:
        """Find the separating lines."""
        self._footprints: list[FloatArray] = []
        self._normal = np.zeros((0, 0, 2))
        self._offset = np.zeros((0, 0))
        self._extend(footprints)

    def extended(self, footprints: Sequence[FloatArray]) -> PainterOrder:
        """Make an order that holds `footprints` too, after those that are there."""
        larger = PainterOrder([])
        larger._footprints = list(self._footprints)
        larger._normal, larger._offset = self._normal, self._offset
        larger._extend(footprints)
        return larger

    def back_to_front(
        self, viewer_xy: FloatArray, heading_rad: float, visible: Sequence[int]
    ) -> list[int]:
        """
        Sort.

        Parameters
        ----------
        viewer_xy : ndarray, shape (2,)
            Where one looks from.
        heading_rad : float
            Where to; what lies more than 80 degrees aside does not matter.
        visible : sequence of int
            Which footprints to sort.

        Returns
        -------
        list of int
            `visible`, farthest first.

        """
        index = np.asarray(visible, dtype=np.intp)
        pairs = np.ix_(index, index)
        side = self._normal[pairs] @ viewer_xy - self._offset[pairs]
        right, left = self._extent(index, viewer_xy, heading_rad)
        overlap = np.minimum(left[:, None], left) - np.maximum(right[:, None], right) > 1e-9
        # Row i, column j: j stands on the viewer's side, so i is painted before j.
        before = (side > 1e-9) & overlap
        blocked_by = before.sum(axis=0)
        remaining = list(range(len(index)))
        order: list[int] = []
        while remaining:
            first = min(remaining, key=lambda k: blocked_by[k])
            remaining.remove(first)
            blocked_by = blocked_by - before[first]
            order.append(int(index[first]))
        return order

    def _extent(
        self, index: npt.NDArray[np.intp], viewer_xy: FloatArray, heading_rad: float
    ) -> tuple[FloatArray, FloatArray]:
        """Azimuths (n,) of the right and left end of footprints, from the heading, clipped."""
        points = self._corners[index] - viewer_xy
        middle = points.mean(axis=1)
        center = wrap_rad(np.arctan2(middle[:, 1], middle[:, 0]) - heading_rad)
        azimuth = np.arctan2(points[..., 1], points[..., 0]) - heading_rad
        # Less than half a turn wide, as the viewer is outside: unwrap about the middle.
        azimuth = center[:, None] + wrap_rad(azimuth - center[:, None])
        limit = _WIDEST_VIEW_RAD
        ends = np.clip([azimuth.min(axis=1), azimuth.max(axis=1)], -limit, limit)
        return ends[0], ends[1]

    def _extend(self, footprints: Sequence[FloatArray]) -> None:
        """Append footprints and their lines: row i has i on the negative, j on the positive."""
        known = len(self._footprints)
        self._footprints += [np.asarray(shape, dtype=np.float64) for shape in footprints]
        self._corners = np.array([shape[_FOUR % len(shape)] for shape in self._footprints])
        count = len(self._footprints)
        normal, offset = np.zeros((count, count, 2)), np.zeros((count, count))
        normal[:known, :known], offset[:known, :known] = self._normal, self._offset
        for j in range(known, count):
            for i in range(j):
                line = _separating_line(self._footprints[i], self._footprints[j])
                normal[i, j], offset[i, j] = line
                normal[j, i], offset[j, i] = -line[0], -line[1]
        self._normal, self._offset = normal, offset


def _separating_line(a: FloatArray, b: FloatArray) -> tuple[FloatArray, float]:
    """Unit normal and offset of the line with `a` on its negative side and `b` beyond it."""
    normal_a, gap_a = _widest_gap(a, b)
    normal_b, gap_b = _widest_gap(b, a)
    if gap_a >= gap_b:
        return normal_a, float((a @ normal_a).max())
    return -normal_b, -float((b @ normal_b).max())


def _widest_gap(a: FloatArray, b: FloatArray) -> tuple[FloatArray, float]:
    """Side of `a` whose outward normal keeps `b` farthest off, and how far that is."""
    side = np.roll(a, -1, axis=0) - a
    outward = np.stack([side[:, 1], -side[:, 0]], -1) / np.linalg.norm(side, axis=1)[:, None]
    gap = (b @ outward.T).min(axis=0) - np.sum(a * outward, -1)
    best = int(np.argmax(gap))
    return outward[best], float(gap[best])
