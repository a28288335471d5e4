"""What came of the contest of triplets: which won, and why the others did not."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from landmark_nav.types import FloatArray, Refusal, Triplet

# A rival is called worse in something from so many times the winner's on.
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


class LandmarkVisibility(IntEnum):
    """Whether a landmark takes part, or why not."""

    USABLE = 0
    NO_IMAGE = 1
    OUT_OF_RANGE = 2
    OUTSIDE_AREA = 3
    HIDDEN = 4
    CUT = 5
    BEYOND_LIMITS = 6

    @property
    def words(self) -> str:
        """For people."""
        return _WORDS[self]


_WORDS = {
    LandmarkVisibility.USABLE: 'usable',
    LandmarkVisibility.NO_IMAGE: 'without an image',
    LandmarkVisibility.OUT_OF_RANGE: 'too near or too far',
    LandmarkVisibility.OUTSIDE_AREA: 'outside the observation area',
    LandmarkVisibility.HIDDEN: 'behind a wall',
    LandmarkVisibility.CUT: 'cut by the border of the image',
    LandmarkVisibility.BEYOND_LIMITS: 'beyond the joint limits',
}


class Verdict(IntEnum):
    """Why a triplet is where it is in a ranking."""

    CHOSEN = 0
    LESS_ACCURATE = 1
    LESS_LIKELY = 2
    LONGER_TURN = 3
    SLIGHTLY_WORSE = 4
    NOT_BETTER_ENOUGH = 5

    @property
    def words(self) -> str:
        """For people."""
        return _VERDICTS[self]


_VERDICTS = {
    Verdict.CHOSEN: 'chosen',
    Verdict.LESS_ACCURATE: 'less accurate',
    Verdict.LESS_LIKELY: 'less likely to be found',
    Verdict.LONGER_TURN: 'longer turn',
    Verdict.SLIGHTLY_WORSE: 'slightly worse in all',
    Verdict.NOT_BETTER_ENOUGH: 'not better enough to give up the one looked at',
}


@dataclass(frozen=True, eq=False)
class Ranking:
    """
    The chosen triplet, or why none, and the m best, in the order of preference.

    Parameters
    ----------
    chosen : Triplet or Refusal
        The first.
    visibility : ndarray of int, shape (n,)
        `LandmarkVisibility` of each landmark of the map.
    ids : ndarray of int, shape (m, 3)
        Landmarks of the triplets.
    covariances : ndarray, shape (m, 3, 3)
        Predicted ones of a fix of the pan axis with the orientation of the base.
    chance : ndarray, shape (m,)
        That all three are found.
    travel_s : ndarray, shape (m,)
        Time to turn there.
    pan_rad : ndarray, shape (m,)
        That sees all three.
    score : ndarray, shape (m,)
        Variance by chance, times the time relative to that of a look; m^2.
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
        """One row (m,) a triplet, for other tools; `reason` is a `Verdict`."""
        rows = np.zeros(len(self.score), dtype=_ROW)
        rows['id'], rows['pan'], rows['sigma'] = self.ids, self.pan_rad[:, None], self.sigma_m
        rows['chance'], rows['travel'], rows['score'] = self.chance, self.travel_s, self.score
        rows['covariance'] = self.covariances.reshape(-1, 9)
        rows['reason'] = self.verdicts()
        return rows

    def landmark_table(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
        """Row (n,) of each landmark in the map, `ids` (n,); `reason` is a `LandmarkVisibility`."""
        rows = np.zeros(len(ids), dtype=_LANDMARK)
        rows['id'], rows['reason'] = ids, self.visibility
        return rows

    def excluded(self) -> dict[str, int]:
        """How many landmarks take no part, by the reason."""
        kinds, counts = np.unique(self.visibility, return_counts=True)
        return {
            LandmarkVisibility(kind).words: int(count)
            for kind, count in zip(kinds, counts, strict=True)
            if kind != LandmarkVisibility.USABLE
        }

    def verdicts(self) -> list[Verdict]:
        """Why each of the m triplets is where it is."""
        # Where none is chosen the first is less accurate than it has to be.
        refused = isinstance(self.chosen, Refusal)
        first = Verdict.LESS_ACCURATE if refused else Verdict.CHOSEN
        return [self._verdict(k) if k else first for k in range(len(self.score))]

    def _verdict(self, place: int) -> Verdict:
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
