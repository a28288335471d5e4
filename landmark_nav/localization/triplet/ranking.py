"""The ranking of triplets: which was chosen, and why the others were not."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from landmark_nav.types import FloatArray, Refusal, Triplet

# A criterion counts as the reason if it is worse than that of the chosen triplet by this factor.
_MUCH_WORSE = 1.05


_ROW = np.dtype(
    [
        ('id', '<u4', (3,)),
        ('pan', '<f8', (3,)),
        ('sigma', '<f8'),
        ('chance', '<f8'),
        ('travel', '<f8'),
        ('score', '<f8'),
        ('covariance', '<f8', (9,)),
        ('reason', '<u1'),
    ]
)
_LANDMARK = np.dtype([('id', '<u4'), ('reason', '<u1')])


class _Reason(IntEnum):
    """A number for messages, with `words` for people."""

    words: str

    def __new__(cls, number: int, words: str = '') -> _Reason:
        member = int.__new__(cls, number)
        member._value_, member.words = number, words
        return member


class LandmarkVisibility(_Reason):
    """Whether a landmark can be part of a triplet, or why not."""

    USABLE = 0, 'usable'
    NO_IMAGE = 1, 'without an image'
    OUT_OF_RANGE = 2, 'too near or too far'
    OUTSIDE_AREA = 3, 'outside the observation area'
    HIDDEN = 4, 'behind a wall'
    CUT = 5, 'cut by the border of the image'
    BEYOND_LIMITS = 6, 'beyond the joint limits'


class Verdict(_Reason):
    """Why a triplet is where it is in a ranking."""

    CHOSEN = 0, 'chosen'
    LESS_ACCURATE = 1, 'less accurate'
    LESS_LIKELY = 2, 'less likely to be found'
    LONGER_TURN = 3, 'longer turn'
    SLIGHTLY_WORSE = 4, 'slightly worse in all'
    NOT_BETTER_ENOUGH = 5, 'not better enough to give up the one looked at'


@dataclass(frozen=True, eq=False)
class Ranking:
    """
    The chosen triplet, or why there is none, and the m best in order of preference.

    Parameters
    ----------
    chosen : Triplet or Refusal
        The best one.
    visibility : ndarray of int, shape (n,)
        `LandmarkVisibility` of each landmark of the map.
    ids : ndarray of int, shape (m, 3)
        Landmarks of the triplets.
    covariances : ndarray, shape (m, 3, 3)
        Predicted covariance of a fix: pan axis with the orientation of the base.
    chance : ndarray, shape (m,)
        Probability that all three are found.
    travel_s : ndarray, shape (m,)
        Time to turn to them.
    pan_rad : ndarray, shape (m,)
        Pan at which all three are in view.
    score : ndarray, shape (m,)
        Variance over chance, times the time relative to that of a look; m^2.
    """

    chosen: Triplet | Refusal
    visibility: npt.NDArray[np.int8]
    ids: npt.NDArray[np.int64]
    covariances: FloatArray
    chance: FloatArray
    travel_s: FloatArray
    pan_rad: FloatArray
    score: FloatArray

    @classmethod
    def none(cls, reason: Refusal, visibility: npt.NDArray[np.int8]) -> Ranking:
        """Return a ranking without triplets."""
        empty = np.empty(0)
        ids = np.empty((0, 3), dtype=np.int64)
        return cls(reason, visibility, ids, np.empty((0, 3, 3)), empty, empty, empty, empty)

    @property
    def sigma_m(self) -> FloatArray:
        """Predicted position sigmas (m,), roots of the trace."""
        return np.asarray(np.sqrt(np.trace(self.covariances[:, :2, :2], axis1=1, axis2=2)))

    def table(self) -> npt.NDArray[np.void]:
        """One row for each triplet (m,), for other tools; `reason` is a `Verdict`."""
        rows = np.zeros(len(self.score), dtype=_ROW)
        rows['id'], rows['pan'], rows['sigma'] = self.ids, self.pan_rad[:, None], self.sigma_m
        rows['chance'], rows['travel'], rows['score'] = self.chance, self.travel_s, self.score
        rows['covariance'] = self.covariances.reshape(-1, 9)
        rows['reason'] = self.verdicts()
        return rows

    def landmark_table(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
        """One row for each landmark (n,) of the map; `reason` is a `LandmarkVisibility`."""
        rows = np.zeros(len(ids), dtype=_LANDMARK)
        rows['id'], rows['reason'] = ids, self.visibility
        return rows

    def excluded(self) -> dict[str, int]:
        """Number of landmarks that are not usable, by reason."""
        kinds, counts = np.unique(self.visibility, return_counts=True)
        return {
            LandmarkVisibility(kind).words: int(count)
            for kind, count in zip(kinds, counts, strict=True)
            if kind != LandmarkVisibility.USABLE
        }

    def verdicts(self) -> list[Verdict]:
        """Reason for the rank of each of the m triplets."""
        return [self._verdict(place) for place in range(len(self.score))]

    def _verdict(self, place: int) -> Verdict:
        if place == 0:
            # If none is chosen, even the best is not accurate enough.
            refused = isinstance(self.chosen, Refusal)
            return Verdict.LESS_ACCURATE if refused else Verdict.CHOSEN
        if self.score[place] < self.score[0]:
            return Verdict.NOT_BETTER_ENOUGH
        sigma = self.sigma_m
        worse = {
            Verdict.LESS_ACCURATE: (sigma[place] / sigma[0]) ** 2,
            Verdict.LESS_LIKELY: self.chance[0] / self.chance[place],
            Verdict.LONGER_TURN: (1.0 + self.travel_s[place]) / (1.0 + self.travel_s[0]),
        }
        what = max(worse, key=lambda verdict: float(worse[verdict]))
        return what if worse[what] >= _MUCH_WORSE else Verdict.SLIGHTLY_WORSE
