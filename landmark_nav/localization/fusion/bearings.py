"""The bearings of one image as the filter takes them: what no filter can use is sorted out."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IndexArray
from landmark_nav.geometry.pan_track import PanTrack
from landmark_nav.localization.fusion.config import FusionConfig
from landmark_nav.localization.joint_delay import JointDelay, PanError
from landmark_nav.types import Detections, FloatArray, Refusal

__all__ = ['BearingFrame', 'FrameMaker']

# Matches of an image that tell what correlation is to be expected in it.
_FEW = 4
# So many correlations of earlier images are kept for images with fewer.
_SCORES = 12
# A swing is looked for at so many times.
_SWING_STEPS = 13
# What of a template's variance a match may leave unexplained: times the median, and some more.
_UNLIKE_TIMES, _UNLIKE_ANYWAY = 6.0, 0.1


@dataclass(frozen=True, eq=False)
class BearingFrame:
    """
    The bearings of one image, ready for the filter.

    `columns` (m,) are places of the landmarks `ids` (m,) in the map, `variance` (m,) what each
    bearing claims of itself and `common_variance` what all of them share, `scores` (m,) their
    correlations, `unusable` what was sorted out before; `config` says how they are used.
    """

    ids: npt.NDArray[np.int64]
    columns: IndexArray
    bearing_rad: FloatArray
    variance: FloatArray
    common_variance: float
    unusable: dict[int, Refusal]
    scores: FloatArray
    config: FusionConfig
    pan_rate: float = 0.0
    pan: float = 0.0
    pan_track: PanTrack | None = None
    pan_delay_s: float = 0.0

    def tailed(self, chosen: IndexArray, factors: FloatArray) -> BearingFrame:
        """Return the frame with as many times the variances of the bearings `chosen`."""
        variance = self.variance.copy()
        variance[chosen] *= factors
        return replace(self, variance=variance)

    def lag(self, late: JointDelay) -> PanError:
        """What joint states that are so late make of all bearings."""
        return late.lag(self.pan_rate, self.pan_track, self.pan_delay_s)

    def pan_range_rad(self, seconds: float) -> float:
        """How far the pan was from that of the image, at most, so much before and after it."""
        if self.pan_track is None:
            return abs(self.pan_rate) * seconds
        times = np.linspace(-seconds, seconds, _SWING_STEPS) + self.pan_delay_s
        pans = self.pan_track.at(times)
        return float(np.abs(pans - pans[_SWING_STEPS // 2]).max())


class FrameMaker:
    """
    Makes the frames of one image after the other: sorts out what no filter can use.

    Parameters
    ----------
    ids : ndarray of int, shape (n,)
        Landmarks, in the order of the map.
    config : FusionConfig
        What bearings share and repeat.
    pan_sigma_rad : float
        Of the measured pan.

    """

    def __init__(
        self, ids: npt.NDArray[np.int64], config: FusionConfig, pan_sigma_rad: float
    ) -> None:
        self._config, self._pan_sigma_rad = config, pan_sigma_rad
        self._columns = {k: column for column, k in enumerate(ids.tolist())}
        self._scores: deque[float] = deque(maxlen=_SCORES)

    def columns(self, ids: npt.NDArray[np.int64]) -> IndexArray:
        """Places in the map of those landmarks that it holds."""
        return np.array([self._columns[k] for k in ids.tolist() if k in self._columns], np.intp)

    def remember(self, scores: FloatArray) -> None:
        """Expect correlations like these of an image that has few."""
        self._scores.extend(scores.tolist())

    def frame(self, detections: Detections) -> BearingFrame:
        """Return the usable bearings of an image, and why the others are not."""
        variance = detections.variance_rad2
        good = np.isfinite(detections.bearing_rad) & np.isfinite(variance) & (variance > 0.0)
        unlike = _unlike_the_others(detections.score, np.array(self._scores))
        unusable: dict[int, Refusal] = {}
        chosen: dict[int, int] = {}
        for k, landmark in enumerate(detections.ids.tolist()):
            if landmark not in self._columns:
                unusable[landmark] = Refusal('not in the map')
            elif not good[k]:
                unusable[landmark] = Refusal('bearing or variance is not a number')
            elif landmark in chosen:
                unusable[landmark] = Refusal('given twice')
            elif unlike[k]:
                unusable[landmark] = Refusal(
                    'less alike than the others', f'correlation {detections.score[k]:.2f}'
                )
            else:
                chosen[landmark] = k
        rows, ids = list(chosen.values()), np.array(list(chosen), dtype=np.int64)
        return BearingFrame(
            ids,
            self.columns(ids),
            detections.bearing_rad[rows],
            variance[rows],
            self._pan_sigma_rad**2 + detections.pan_sigma_rad**2,
            unusable,
            detections.score[rows],
            self._config,
            detections.pan_rate_rad_s,
            detections.pan_rad,
            detections.pan_track,
            detections.pan_delay_s,
        )


def _unlike_the_others(score: FloatArray, before: FloatArray) -> npt.NDArray[np.bool_]:
    """
    Which matches leave far more unexplained than the others of their image, (n,).

    Light, blur and noise lower all correlations of an image together. A match that is far worse
    than the others shows something else, such as a poster that was exchanged; its bearing is off
    by the same amount in image after image, which its variance does not cover. Where an image
    has few matches, the correlations of the images `before` count as well; if all matches are
    worse than those, it is the light.
    """
    others = score if len(score) >= _FEW else np.append(score, before)
    if len(others) < _FEW:
        return np.zeros(len(score), dtype=np.bool_)
    limit = _UNLIKE_TIMES * median((1.0 - others**2).tolist()) + _UNLIKE_ANYWAY
    unlike = np.asarray(1.0 - score**2 > limit)
    return unlike & ~unlike.all()
