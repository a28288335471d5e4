"""Order in which upright things are painted so that the nearer covers the farther."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

__all__ = ['PainterOrder']

FloatArray = npt.NDArray[np.float64]


class PainterOrder:
    """
    Back-to-front order of upright prisms, by lines that separate their footprints.

    Two convex footprints that do not overlap have a line between them that runs along a side of
    one of them. What lies on the viewer's side of it can cover the other and is never covered by
    it, so the order is exact. Newell, Newell and Sancha, A solution to the hidden surface
    problem, ACM 1972, is the general case.

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

    def back_to_front(self, viewer_xy: FloatArray, visible: Sequence[int]) -> list[int]:
        """
        Sort.

        Parameters
        ----------
        viewer_xy : ndarray, shape (2,)
            Where one looks from.
        visible : sequence of int
            Which footprints matter. Those in a view of less than half a turn have an order;
            should more be asked for and go in circles, the circle is cut somewhere.

        Returns
        -------
        list of int
            `visible`, farthest first.

        """
        index = np.asarray(visible, dtype=np.intp)
        pairs = np.ix_(index, index)
        side = self._normal[pairs] @ viewer_xy - self._offset[pairs]
        # Row i, column j: j stands on the viewer's side, so i is painted before j.
        blocked_by = (side > 1e-9).sum(axis=0)
        remaining = list(range(len(index)))
        order: list[int] = []
        while remaining:
            first = min(remaining, key=lambda k: blocked_by[k])
            remaining.remove(first)
            blocked_by = blocked_by - (side[first] > 1e-9)
            order.append(int(index[first]))
        return order

    def _extend(self, footprints: Sequence[FloatArray]) -> None:
        """Append footprints and their lines: row i has i on the negative, j on the positive."""
        known = len(self._footprints)
        self._footprints += [np.asarray(shape, dtype=np.float64) for shape in footprints]
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
