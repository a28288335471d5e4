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

# Correlation of a match that is hardly ever mistaken: in 784 images searched from wrong poses
# (0.15 to 1 m off) one in twenty of the mistaken matches reached it, never three in one image.
_SURE_SCORE = 0.95
# After so many images in a row without any landmark, gates narrow to this chi-square level.
_IN_VAIN, _DOUBTFUL_LEVEL = 3, 0.95
# The NIS of so many measurements is tested as a sum, at this chi-square level. It is taken as
# correlated: so many measurements in a row repeat one error, that of the same landmarks.
_NIS_WINDOW, _NIS_LEVEL, _NIS_REPEATS = 10, 0.999, 5.0
# So many measurements in a row must be accepted until the filter is no longer lost.
_FOUND_AFTER_ACCEPTANCES = 3
# Share of the expected landmarks that must be found for an image to be used.
_USABLE_SHARE = 0.3
# Trouble with the odometry is reported for the first of these times. What images contradict is
# reported for as long as they contradicted it before, but within these two times.
_TROUBLE_S, _MOST_TROUBLE_S = 2.0, 6.0

Status = Literal['tracking', 'coasting', 'lost']


class _Trouble(NamedTuple):
    """What makes the pose unsure from `stamp_ns` on, for so many seconds."""

    stamp_ns: int
    seconds: float
    reason: str


class Health:
    """Judges the filter by what became of its measurements and by what images show."""

    def __init__(self, config: HealthConfig) -> None:
        """Begin as ``lost``: no start pose is known."""
        self._config = config
        self._accepted_ns: int | None = None
        self._rejections = 0
        # Landmarks that agreed with the pose, and those that do not since the last that did.
        self._agreed: set[int] = set()
        self._against: set[int] = set()
        self._acceptances = 0
        self._astray: str = ''
        self._last_refusal: str = ''
        self._blind_why = ''
        self._window: deque[tuple[float, int]] = deque(maxlen=_NIS_WINDOW)
        self._views = Views()
        self._doubts = 0
        self._trouble = _Trouble(-(10**18), 0.0, '')
        self._contradictions = Contradictions()
        self._vain = 0

    def restart(self, stamp_ns: int) -> None:
        """Begin anew with a pose given at that time; only recent contradictions are kept."""
        self._accepted_ns = stamp_ns
        self._rejections = self._acceptances = 0
        self._astray = self._last_refusal = self._blind_why = ''
        self._doubts = self._vain = 0
        self.change_map()

    def change_map(self) -> None:
        """Forget what was seen of the landmarks; the present verdict stays."""
        self._window.clear()
        self._views.clear()
        self._agreed.clear()
        self._against.clear()

    @property
    def astray(self) -> bool:
        """Whether the state is not believed, as measurements keep contradicting it."""
        return bool(self._astray)

    @property
    def repeats(self) -> bool:
        """Whether images have contradicted the pose too long for a coincidence."""
        return self._contradictions.seconds > _TROUBLE_S

    @property
    def blind_since_ns(self) -> int | None:
        """Time since which no image shows landmarks that earlier ones showed; None if not so."""
        return self._views.blind_since_ns

    @property
    def doubts(self) -> int:
        """
        How many images since the filter got lost contradict the pose without being rejected.

        They show hardly any of the expected landmarks, or their innovations stay too large.
        """
        return self._doubts

    def unseen_s(self, stamp_ns: int) -> float:
        """Seconds without an accepted measurement until then; 0 if too few to be coasting."""
        seconds = 0.0 if self._accepted_ns is None else (stamp_ns - self._accepted_ns) * 1e-9
        return seconds if seconds > self._config.coasting_after_s else 0.0

    def least(self, expected: int) -> int:
        """
        How many bearings must agree for an image with so many expected landmarks to be used.

        After a contradiction it takes three: fewer may agree with a wrong pose by chance.
        """
        if self._astray:
            return max(AGREE, ceil(FOUND_SHARE * expected))
        return min(AGREE, max(expected, 1)) if self._rejections else 1

    def by_chance(self, found: int, expected: int) -> Refusal | None:
        """Why a fix from so few of the expected landmarks is not used while lost; else None."""
        if not self._astray or found >= self.least(expected):
            return None
        return Refusal('too few found', f'{found} of {expected} landmarks')

    def level(self, found: int, usual: float) -> float:
        """
        Chi-square level of the gates for an image with `found` bearings.

        It is lower than `usual` where few bearings follow images that contradicted the pose or
        showed no landmark: bearings just inside a wide gate would be no evidence for the pose.
        """
        doubtful = self._rejections > 0 or self._vain >= _IN_VAIN
        return min(usual, _DOUBTFUL_LEVEL) if doubtful and found < AGREE else usual

    def unusable(self, scores: FloatArray, expected: int) -> Refusal | None:
        """Why all matches, with correlations (m,), may be mistaken; None if they are not."""
        found = len(scores)
        if not found:
            return Refusal('no usable bearing', f'of {expected} landmarks looked for')
        if np.count_nonzero(scores >= _SURE_SCORE) >= AGREE or found >= _USABLE_SHARE * expected:
            return None
        return Refusal('too few found', f'{found} of {expected} landmarks')

    def note_trouble(self, stamp_ns: int, refusal: Refusal) -> None:
        """Remember that the odometry cannot be right."""
        self._trouble = _Trouble(stamp_ns, _TROUBLE_S, str(refusal))

    def note_blind(self, refusal: Refusal) -> None:
        """Remember why no landmark may be in sight, until one is."""
        self._blind_why = str(refusal)

    def note_surprise(self, stamp_ns: int, refusal: Refusal) -> None:
        """Remember that images contradict something, though the pose may be right."""
        seconds = max(_TROUBLE_S, min(self._contradictions.note(stamp_ns), _MOST_TROUBLE_S))
        self._trouble = _Trouble(stamp_ns, seconds, str(refusal))

    def note_picture(
        self,
        stamp_ns: int,
        found: IndexArray,
        missed: IndexArray,
        places: FloatArray,
        elsewhere: int = 0,
    ) -> None:
        """
        Take note of which of the expected landmarks an image showed.

        Parameters
        ----------
        stamp_ns : int
            Of the image.
        found, missed : ndarray of int, shape (m,), (n,)
            Landmarks that agree with the pose, and those that were not found.
        places : ndarray, shape (n, 3)
            Positions of those not found, in map.
        elsewhere : int
            How many bearings contradict the accepted ones. With a right pose and a calibrated
            camera hardly any do.

        """
        if not len(found) and not len(missed):
            return
        self._vain = 0 if len(found) else self._vain + 1
        self._views.add(stamp_ns, found, missed, places, elsewhere)
        if many := self._views.elsewhere():
            self.note_surprise(stamp_ns, Refusal('landmarks lie elsewhere', many))
        if few := self._views.missing():
            self.doubt(stamp_ns, few)

    def note_refusal(self, refusal: Refusal) -> None:
        """Remember why the last measurement was not used."""
        self._last_refusal = f', last: {refusal}'

    def note_update(self, update: FusionUpdate) -> None:
        """Take note of what became of a measurement."""
        if update.degrees:
            self._rejections = 0
            self._agreed.update(update.accepted_ids.tolist())
            self._against.clear()
            self._last_refusal = self._blind_why = ''
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
            self.note_refusal(update.refusal)
            self._acceptances = 0
            if not update.contradicts:
                return
            self._rejections += 1
            self._against.update(update.rejected)
            if self._rejections >= self._config.lost_after_rejections and not self._exchanged():
                self._contradict(
                    update.stamp_ns,
                    f'{self._rejections} measurements rejected and none used, last: '
                    f'{update.refusal}',
                )
                self._window.clear()

    def _exchanged(self) -> bool:
        """
        Whether posters may have been exchanged that were never seen at this pose.

        They contradict it as often as the camera looks at them.
        """
        few = 0 < len(self._against) < self._config.lost_after_rejections
        return few and bool(self._agreed) and self._agreed.isdisjoint(self._against)

    def doubt(self, stamp_ns: int, why: str) -> None:
        """Call the pose lost; each call widens it further."""
        self._doubts += 1
        self._acceptances = 0
        self._contradict(stamp_ns, why)

    def _contradict(self, stamp_ns: int, why: str) -> None:
        """Call the pose lost, and unsure for some time afterwards if that happened often."""
        self._astray = why
        lasts = self._contradictions.note(stamp_ns)
        if lasts > _TROUBLE_S:
            seconds = min(lasts, _MOST_TROUBLE_S) - _TROUBLE_S
            often = f'contradicted for {lasts:.0f} s of the last 30 s, last: {why}'
            self._trouble = _Trouble(stamp_ns, seconds, often)

    def _innovations(self) -> tuple[float, float]:
        """Sum of the NIS of the last measurements, and its limit."""
        nis, degrees = np.sum(self._window, axis=0)
        repeats = min(_NIS_REPEATS, len(self._window))
        limit = float(chdtri(max(degrees / repeats, 1.0), 1.0 - _NIS_LEVEL))
        return float(nis), repeats * limit

    def status(
        self, estimate: PoseEstimate | None, odometry_ns: int | None = None
    ) -> tuple[Status, str]:
        """
        Judge an estimate by the last odometry, at `odometry_ns` (None before any came).

        The reason is empty while tracking.
        """
        if estimate is None or self._accepted_ns is None:
            return 'lost', 'no start pose: give one on initialpose or call relocalize'
        blind = self._blind(estimate.stamp_ns, odometry_ns)
        if astray := self._astray or self.too_wide(estimate):
            return 'lost', f'{astray}; {blind}' if blind else astray
        waited = self.unseen_s(estimate.stamp_ns)
        if odometry_ns is not None and waited:
            return 'coasting', f'nothing accepted for {waited:.1f} s{self._last_refusal}'
        if blind or self._blind_why:
            return 'coasting', blind or self._blind_why
        if 0.0 <= (estimate.stamp_ns - self._trouble.stamp_ns) * 1e-9 < self._trouble.seconds:
            return 'coasting', self._trouble.reason
        return 'tracking', ''

    def too_wide(self, estimate: PoseEstimate) -> str:
        """How uncertain an estimate is, in words; empty if that does not make it lost."""
        sigma = float(np.sqrt(np.trace(estimate.covariance[:2, :2])))
        sigma_heading = float(np.sqrt(estimate.covariance[2, 2]))
        if sigma <= self._config.lost_sigma_m and sigma_heading <= self._config.lost_sigma_rad:
            return ''
        return f'sigma is {sigma:.2f} m and {np.degrees(sigma_heading):.1f} deg'

    def _blind(self, stamp_ns: int, odometry_ns: int | None) -> str:
        """How long odometry has been missing, in words; empty if it is not."""
        if odometry_ns is None:
            return 'no odometry yet'
        seconds = (stamp_ns - odometry_ns) * 1e-9
        if seconds <= self._config.silent_after_s:
            return ''
        reason = self._trouble.reason
        return f'no odometry for {seconds:.1f} s' + (f', last: {reason}' if reason else '')
