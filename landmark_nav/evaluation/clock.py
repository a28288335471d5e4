"""One time for a run whose clock was set back: the odometry shows when that was."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IntArray

__all__ = ['shifts_by_odometry']

# Odometry that goes back by more is not late.
_STEP_NS = 500_000_000
# Between the last odometry before and the first after.
_GAP_NS = 100_000_000


def shifts_by_odometry(
    stamps_ns: npt.ArrayLike, after: npt.ArrayLike, odometry_ns: npt.ArrayLike
) -> IntArray:
    """
    What to add to stamps, so that each time comes once.

    Parameters
    ----------
    stamps_ns : array_like of int, shape (m,)
        Stamps of the odometry itself, or of what was recorded beside it.
    after : array_like of int, shape (m,)
        Place of the odometry that came last before each; -1 for none.
    odometry_ns : array_like of int, shape (n,)
        Stamps of the odometry, as they came.

    Returns
    -------
    ndarray of int, shape (m,)
        0 where no clock was set back.

    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    clock = np.asarray(odometry_ns, dtype=np.int64)
    if not len(clock):
        return np.zeros_like(stamps)
    back = np.maximum(-np.diff(clock, prepend=clock[0]), 0)
    back[back < _STEP_NS] = 0
    shift = np.cumsum(back + _GAP_NS * (back > 0))
    last = np.maximum(np.asarray(after, dtype=np.intp), 0)
    following = np.minimum(last + 1, len(clock) - 1)
    stepped = np.maximum.accumulate(np.where(back > 0, np.arange(len(clock)), 0))[last]
    ahead = stamps - clock[last]
    # Messages of one moment come in any order: some by the new clock before the odometry is, some
    # by the old one after it.
    early = -2 * ahead > np.where(back[following] > 0, back[following], np.inf)
    late = 2 * ahead > np.where(stepped > 0, back[stepped], np.inf)
    return shift[np.where(early, following, np.where(late, stepped - 1, last))]
