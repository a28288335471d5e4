"""Whether the filter can be believed: tracking, coasting or lost, and why."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import ceil
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtri

from landmark_nav.localization.fusion.update import FusionUpdate
from landmark_nav.parameters import Config, parameter
from landmark_nav.types import FloatArray, PoseEstimate, Refusal

__all__ = ['Health', 'HealthConfig', 'Status']

# So many landmarks have a say of their own.
_AGREE = 3
# Correlation of a match that is not mistaken: seen from wrong poses (0.15 to 1 m off) a twentieth
# of all mistaken matches reached it, and never three in one picture of 784.
_SURE_SCORE = 0.95
# Measurements accepted in a row until no longer lost.
_FOUND_AFTER_ACCEPTANCES = 3
# Share of what should be in a picture that has to be found for it to be used; and to be no longer
# lost.
_USABLE_SHARE, _FOUND_SHARE = 0.3, 0.4
# Lost is who finds next to nothing, this share, of what should be in view, so many landmarks at
# least, in so many seconds. What is missing must reach further along the walls than that: one
# picture may be exchanged.
_MISSING_SHARE, _MISSING_EXPECTED, _MISSING_S, _MISSING_EXTENT_M = 0.15, 10, 1.4, 1.5
# How long trouble with the odometry is told.
_TROUBLE_S = 2.0

Status = Literal['tracking', 'coasting', 'lost']


@dataclass(frozen=True)
class HealthConfig(Config):
    """When the filter calls itself coasting or lost."""

    coasting_after_s: float = parameter(
        1.0, 'Seconds without an accepted measurement until coasting.', minimum=0.0, maximum=3600.0
    )
    silent_after_s: float = parameter(
        0.7, 'Seconds without odometry until coasting.', minimum=0.0, maximum=3600.0
    )
    lost_after_rejections: int = parameter(
        5, 'Measurements rejected in a row until lost.', minimum=1, maximum=1000
    )
    lost_sigma_m: float = parameter(
        1.0, 'Position sigma (root of the trace) above which the filter is lost, m.', minimum=0.0
    )
    lost_sigma_rad: float = parameter(
        0.5, 'Heading sigma above which the filter is lost, rad.', minimum=0.0
    )
    nis_window: int = parameter(
        10, 'Accepted measurements whose innovations are judged together.', minimum=1, maximum=1000
    )
    nis_correlation: float = parameter(
        5.0,
        'How many measurements in a row repeat one error: the same landmarks, the same map.',
        minimum=1.0,
        maximum=1000.0,
    )
    nis_probability: float = parameter(
        0.999, 'Chi-square level of that window.', minimum=0.5, maximum=1.0
    )


class _View(NamedTuple):
    """What a picture showed."""

    stamp_ns: int
    found: int
    missed: FloatArray


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
        self._window: deque[tuple[float, int]] = deque(maxlen=config.nis_window)
        self._views: deque[_View] = deque()
        self._doubts = 0
        self._trouble = (-(10**18), '')

    def restart(self, stamp_ns: int) -> None:
        """Forget everything: a pose was given at that time."""
        self._accepted_ns = stamp_ns
        self._rejections = self._acceptances = 0
        self._astray = self._last_refusal = ''
        self._doubts = 0
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
    def doubts(self) -> int:
        """
        Pictures since lost that speak against the pose though nothing of them was rejected.

        Next to nothing is found of what should be there, or innovations stay too large.
        """
        return self._doubts

    def least(self, expected: int) -> int:
        """
        How many bearings must agree with each other where so many should be in view.

        What agrees with a pose that was contradicted before may be mistaken: three bearings have
        a say of their own.
        """
        if self._astray:
            return max(_AGREE, ceil(_FOUND_SHARE * expected))
        return _AGREE if self._rejections and expected >= _AGREE else 1

    def too_few(self, scores: FloatArray, expected: int) -> bool:
        """Whether those found among so many that are missing may be mistaken themselves."""
        sure = np.count_nonzero(scores >= _SURE_SCORE) >= _AGREE
        return not sure and len(scores) < _USABLE_SHARE * expected

    def note_trouble(self, stamp_ns: int, refusal: Refusal) -> None:
        """Remember that the odometry cannot be what it says."""
        self._trouble = (stamp_ns, str(refusal))

    def look(self, stamp_ns: int, found: int, missed: FloatArray) -> None:
        """
        Count what a picture showed of the landmarks that should be in view.

        A wrong pose finds next to nothing where it looks, for as long as it is wrong; a covered
        landmark or an exchanged picture leaves the others. `missed` (n, 3) are the places of those
        not found.
        """
        if not found and not len(missed):
            return
        self._views.append(_View(stamp_ns, found, missed))
        while abs(stamp_ns - self._views[0].stamp_ns) * 1e-9 > _MISSING_S:
            self._views.popleft()
        places = np.concatenate([view.missed for view in self._views])
        found = sum(view.found for view in self._views)
        expected = found + len(places)
        lasts = (stamp_ns - self._views[0].stamp_ns) * 1e-9 >= 0.6 * _MISSING_S
        enough = lasts and expected >= _MISSING_EXPECTED
        if not enough or found > _MISSING_SHARE * expected:
            return
        if np.linalg.norm(np.ptp(places[:, :2], axis=0)) > _MISSING_EXTENT_M:
            self._doubt(
                f'{found} of {expected} landmarks that should be in the last '
                f'{len(self._views)} pictures were found'
            )

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
                self._doubt(
                    f'innovations are too large: NIS {nis:.0f} over the last {len(self._window)} '
                    f'measurements, limit {limit:.0f}'
                )
            elif self._acceptances >= _FOUND_AFTER_ACCEPTANCES:
                self._astray = ''
                self._doubts = 0
        elif update.refusal is not None:
            self.note(update.refusal)
            self._rejections += 1
            self._acceptances = 0
            if self._rejections >= self._config.lost_after_rejections:
                self._astray = (
                    f'{self._rejections} measurements rejected in a row, last: {update.refusal}'
                )
                self._window.clear()

    def _doubt(self, why: str) -> None:
        """Believe the pose no longer, and less with each picture."""
        self._doubts += 1
        self._acceptances = 0
        self._astray = why

    def _innovations(self) -> tuple[float, float]:
        """NIS of the last measurements together, and what it may be."""
        nis, degrees = np.sum(self._window, axis=0)
        repeats = min(self._config.nis_correlation, len(self._window))
        level = 1.0 - self._config.nis_probability
        return float(nis), repeats * float(chdtri(max(degrees / repeats, 1.0), level))

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
        sigma = float(np.sqrt(np.trace(estimate.covariance[:2, :2])))
        sigma_heading = float(np.sqrt(estimate.covariance[2, 2]))
        astray = self._astray
        if sigma > self._config.lost_sigma_m or sigma_heading > self._config.lost_sigma_rad:
            astray = astray or f'sigma is {sigma:.2f} m and {np.degrees(sigma_heading):.1f} deg'
        if astray:
            return 'lost', f'{astray}; {blind}' if blind else astray
        waited = (estimate.stamp_ns - self._accepted_ns) * 1e-9
        if odometry_ns is not None and waited > self._config.coasting_after_s:
            return 'coasting', f'nothing accepted for {waited:.1f} s{self._last_refusal}'
        if blind:
            return 'coasting', blind
        trouble, reason = self._trouble
        if 0.0 <= (estimate.stamp_ns - trouble) * 1e-9 < _TROUBLE_S:
            return 'coasting', reason
        return 'tracking', ''

    def _blind(self, stamp_ns: int, odometry_ns: int | None) -> str:
        """Say whether odometry is missing, and why it may be."""
        if odometry_ns is None:
            return 'no odometry yet'
        seconds = (stamp_ns - odometry_ns) * 1e-9
        if seconds <= self._config.silent_after_s:
            return ''
        _, reason = self._trouble
        return f'no odometry for {seconds:.1f} s' + (f', last: {reason}' if reason else '')
