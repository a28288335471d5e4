"""Whether the filter can be believed: tracking, coasting or lost, and why."""

from __future__ import annotations

from collections import deque
from math import ceil
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtri

from landmark_nav.arrays import IndexArray
from landmark_nav.localization.fusion.config import HealthConfig
from landmark_nav.localization.fusion.contradictions import Contradictions
from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.localization.fusion.views import AGREE, FOUND_SHARE, Views
from landmark_nav.types import FloatArray, PoseEstimate, Refusal

__all__ = ['Health', 'HealthConfig', 'Status']

# Correlation of a match that is not mistaken: seen from wrong poses (0.15 to 1 m off) a twentieth
# of all mistaken matches reached it, and never three in one picture of 784.
_SURE_SCORE = 0.95
# Pictures in a row that show nothing of what they should, and the level of gates from then on.
_IN_VAIN, _DOUBTFUL_LEVEL = 3, 0.95
# So many measurements are judged together by their innovations, at this chi-square level; so many
# in a row repeat one error: the same landmarks, the same map.
_NIS_WINDOW, _NIS_LEVEL, _NIS_REPEATS = 10, 0.999, 5.0
# Measurements accepted in a row until no longer lost.
_FOUND_AFTER_ACCEPTANCES = 3
# Share of what should be in a picture that has to be found for it to be used.
_USABLE_SHARE = 0.3
# How long trouble with the odometry is told, and what pictures contradict; that, for as long as it
# was contradicted before, but for no longer than this.
_TROUBLE_S, _MOST_TROUBLE_S = 2.0, 6.0

Status = Literal['tracking', 'coasting', 'lost']


class _Trouble(NamedTuple):
    """Why nothing is sure from a time on, for so long."""

    stamp_ns: int
    seconds: float
    reason: str


class Health:
    """Counts what was accepted and rejected."""

    def __init__(self, config: HealthConfig) -> None:
        """Start as never initialized."""
        self._config = config
        self._accepted_ns: int | None = None
        self._rejections = 0
        self._acceptances = 0
        self._astray: str = ''
        self._last_refusal: str = ''
        self._window: deque[tuple[float, int]] = deque(maxlen=_NIS_WINDOW)
        self._views = Views()
        self._doubts = 0
        self._trouble = _Trouble(-(10**18), 0.0, '')
        self._contradictions = Contradictions()
        self._vain = 0

    def restart(self, stamp_ns: int) -> None:
        """Begin anew: a pose was given at that time. What was contradicted of late is kept."""
        self._accepted_ns = stamp_ns
        self._rejections = self._acceptances = 0
        self._astray = self._last_refusal = ''
        self._doubts = self._vain = 0
        self.change_map()

    def change_map(self) -> None:
        """Judge no more by what was seen of the landmarks so far; a verdict stays."""
        self._window.clear()
        self._views.clear()

    @property
    def astray(self) -> bool:
        """Whether measurements have contradicted the state for so long that it is not believed."""
        return bool(self._astray)

    @property
    def repeats(self) -> bool:
        """Whether pictures contradicted the pose for so long of late that it is no accident."""
        return self._contradictions.seconds > _TROUBLE_S

    @property
    def blind_since_ns(self) -> int | None:
        """Time since which pictures show nothing of what others have shown."""
        return self._views.blind_since_ns

    @property
    def doubts(self) -> int:
        """
        Pictures since lost that speak against the pose though nothing of them was rejected.

        Next to nothing is found of what should be there, or innovations stay too large.
        """
        return self._doubts

    def unseen_s(self, stamp_ns: int) -> float:
        """How long nothing was accepted before a time, if that is long enough to coast; else 0."""
        seconds = 0.0 if self._accepted_ns is None else (stamp_ns - self._accepted_ns) * 1e-9
        return seconds if seconds > self._config.coasting_after_s else 0.0

    def least(self, expected: int) -> int:
        """
        How many bearings must agree with each other where so many should be in view.

        What agrees with a pose that was contradicted before may be mistaken: three bearings have
        a say of their own.
        """
        if self._astray:
            return max(AGREE, ceil(FOUND_SHARE * expected))
        return min(AGREE, max(expected, 1)) if self._rejections else 1

    def by_chance(self, found: int, expected: int) -> Refusal | None:
        """Why a pose of so many landmarks, of those expected, may agree by chance when lost."""
        if not self._astray or found >= self.least(expected):
            return None
        return Refusal('too few found', f'{found} of {expected} landmarks')

    def level(self, found: int, usual: float) -> float:
        """
        Chi-square level of the gates for so many bearings.

        Where pictures before contradicted the pose, or showed nothing of what they should, it is
        no evidence for it that a few lie just within what could be.
        """
        doubtful = self._rejections > 0 or self._vain >= _IN_VAIN
        return min(usual, _DOUBTFUL_LEVEL) if doubtful and found < AGREE else usual

    def unusable(self, scores: FloatArray, expected: int) -> Refusal | None:
        """Why those found, by their correlations, of so many expected may all be mistaken."""
        found = len(scores)
        if not found:
            return Refusal('no usable bearing', f'of {expected} landmarks looked for')
        if np.count_nonzero(scores >= _SURE_SCORE) >= AGREE or found >= _USABLE_SHARE * expected:
            return None
        return Refusal('too few found', f'{found} of {expected} landmarks')

    def note_trouble(self, stamp_ns: int, refusal: Refusal) -> None:
        """Remember that the odometry cannot be what it says."""
        self._trouble = _Trouble(stamp_ns, _TROUBLE_S, str(refusal))

    def note_surprise(self, stamp_ns: int, refusal: Refusal) -> None:
        """Remember what pictures contradict though the pose may be right."""
        seconds = max(_TROUBLE_S, min(self._contradictions.note(stamp_ns), _MOST_TROUBLE_S))
        self._trouble = _Trouble(stamp_ns, seconds, str(refusal))

    def look(
        self,
        stamp_ns: int,
        found: IndexArray,
        missed: IndexArray,
        places: FloatArray,
        elsewhere: int = 0,
    ) -> None:
        """
        Take note of what a picture showed of the landmarks that should be in view.

        Parameters
        ----------
        stamp_ns : int
            Of the picture.
        found, missed : ndarray of int, shape (m,), (n,)
            Those that agree with the pose, and those not found.
        places : ndarray, shape (n, 3)
            Where those not found should be.
        elsewhere : int
            How many contradict many others. Of a right pose, and a camera as it was calibrated,
            hardly any do.

        """
        if not len(found) and not len(missed):
            return
        self._vain = 0 if len(found) else self._vain + 1
        self._views.add(stamp_ns, found, missed, places, elsewhere)
        if many := self._views.elsewhere():
            self.note_surprise(stamp_ns, Refusal('landmarks lie elsewhere', many))
        if few := self._views.missing():
            self.doubt(stamp_ns, few)

    def note(self, refusal: Refusal) -> None:
        """Remember why a measurement could not even be tried."""
        self._last_refusal = f', last: {refusal}'

    def observe(self, update: FusionUpdate) -> None:
        """Take note of a measurement's fate."""
        if update.degrees:
            self._rejections = 0
            self._last_refusal = ''
            self._acceptances += 1
            self._accepted_ns = max(self._accepted_ns or 0, update.stamp_ns)
            self._window.append((update.nis, update.degrees))
            nis, limit = self._innovations()
            if nis > limit:
                self.doubt(
                    update.stamp_ns,
                    f'innovations are too large: NIS {nis:.0f} over the last {len(self._window)} '
                    f'measurements, limit {limit:.0f}',
                )
            elif self._acceptances >= _FOUND_AFTER_ACCEPTANCES:
                self._astray = ''
                self._doubts = 0
        elif update.refusal is not None:
            self.note(update.refusal)
            self._rejections += 1
            self._acceptances = 0
            if self._rejections >= self._config.lost_after_rejections:
                self._contradict(
                    update.stamp_ns,
                    f'{self._rejections} measurements rejected in a row, last: {update.refusal}',
                )
                self._window.clear()

    def doubt(self, stamp_ns: int, why: str) -> None:
        """Believe the pose no longer, and less with each picture."""
        self._doubts += 1
        self._acceptances = 0
        self._contradict(stamp_ns, why)

    def _contradict(self, stamp_ns: int, why: str) -> None:
        """Believe the pose no longer; nor those after it for a while, if that is nothing new."""
        self._astray = why
        lasts = self._contradictions.note(stamp_ns)
        if lasts > _TROUBLE_S:
            seconds = min(lasts, _MOST_TROUBLE_S) - _TROUBLE_S
            often = f'contradicted for {lasts:.0f} s of the last 30 s, last: {why}'
            self._trouble = _Trouble(stamp_ns, seconds, often)

    def _innovations(self) -> tuple[float, float]:
        """NIS of the last measurements together, and what it may be."""
        nis, degrees = np.sum(self._window, axis=0)
        repeats = min(_NIS_REPEATS, len(self._window))
        limit = float(chdtri(max(degrees / repeats, 1.0), 1.0 - _NIS_LEVEL))
        return float(nis), repeats * limit

    def status(
        self, estimate: PoseEstimate | None, odometry_ns: int | None = None
    ) -> tuple[Status, str]:
        """
        Judge an estimate; the reason is empty while tracking.

        `odometry_ns` is the time of the last odometry, None before any came.
        """
        if estimate is None or self._accepted_ns is None:
            return 'lost', 'no start pose: give one on initialpose or call relocalize'
        blind = self._blind(estimate.stamp_ns, odometry_ns)
        if astray := self._astray or self.too_wide(estimate):
            return 'lost', f'{astray}; {blind}' if blind else astray
        waited = self.unseen_s(estimate.stamp_ns)
        if odometry_ns is not None and waited:
            return 'coasting', f'nothing accepted for {waited:.1f} s{self._last_refusal}'
        if blind:
            return 'coasting', blind
        if 0.0 <= (estimate.stamp_ns - self._trouble.stamp_ns) * 1e-9 < self._trouble.seconds:
            return 'coasting', self._trouble.reason
        return 'tracking', ''

    def too_wide(self, estimate: PoseEstimate) -> str:
        """How wide an estimate is, if landmarks of elsewhere may fit it."""
        sigma = float(np.sqrt(np.trace(estimate.covariance[:2, :2])))
        sigma_heading = float(np.sqrt(estimate.covariance[2, 2]))
        if sigma <= self._config.lost_sigma_m and sigma_heading <= self._config.lost_sigma_rad:
            return ''
        return f'sigma is {sigma:.2f} m and {np.degrees(sigma_heading):.1f} deg'

    def _blind(self, stamp_ns: int, odometry_ns: int | None) -> str:
        """Say whether odometry is missing, and why it may be."""
        if odometry_ns is None:
            return 'no odometry yet'
        seconds = (stamp_ns - odometry_ns) * 1e-9
        if seconds <= self._config.silent_after_s:
            return ''
        reason = self._trouble.reason
        return f'no odometry for {seconds:.1f} s' + (f', last: {reason}' if reason else '')
