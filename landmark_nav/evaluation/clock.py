"""One time for a run whose clock was set back: ground truth tells when that was."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IntArray
from landmark_nav.evaluation.tracks import PoseTrack
from landmark_nav.types import FloatArray

__all__ = ['shifts_by_truth', 'track_by_truth']

# Truth that goes back by more is not late.
_STEP_NS = 500_000_000
# Between the last pose of the truth before and the first after.
_GAP_NS = 100_000_000


def shifts_by_truth(
    stamps_ns: npt.ArrayLike, after: npt.ArrayLike, truth_ns: npt.ArrayLike
) -> IntArray:
    """
    What to add to stamps, so that each time comes once.

    Parameters
    ----------
    stamps_ns : array_like of int, shape (m,)
        Stamps of the truth itself, or of what is compared with it.
    after : array_like of int, shape (m,)
        Place of the pose of the truth that came last before each; -1 for none.
    truth_ns : array_like of int, shape (n,)
        Stamps of the truth, as they came.

    Returns
    -------
    ndarray of int, shape (m,)
        0 without truth.

    """
    stamps, truth = np.asarray(stamps_ns, dtype=np.int64), np.asarray(truth_ns, dtype=np.int64)
    if not len(truth):
        return np.zeros_like(stamps)
    back = np.maximum(-np.diff(truth, prepend=truth[0]), 0)
    back[back < _STEP_NS] = 0
    shift = np.cumsum(back + _GAP_NS * (back > 0))
    last = np.maximum(np.asarray(after, dtype=np.intp), 0)
    following = np.minimum(last + 1, len(truth) - 1)
    stepped = np.maximum.accumulate(np.where(back > 0, np.arange(len(truth)), 0))[last]
    ahead = stamps - truth[last]
    # Messages of one moment come in any order: some by the new clock before the truth is, some by
    # the old one after it.
    early = -2 * ahead > np.where(back[following] > 0, back[following], np.inf)
    late = 2 * ahead > np.where(stepped > 0, back[stepped], np.inf)
    return shift[np.where(early, following, np.where(late, stepped - 1, last))]


def track_by_truth(
    stamped: Sequence[tuple[int, FloatArray]], after: Sequence[int], truth_ns: Sequence[int]
) -> PoseTrack:
    """Poses (3,) with their stamps as a track; `after` and `truth_ns` as above."""
    shifts = shifts_by_truth([stamp for stamp, _ in stamped], after, truth_ns).tolist()
    return PoseTrack.of(
        (stamp + shift, pose) for (stamp, pose), shift in zip(stamped, shifts, strict=True)
    )
