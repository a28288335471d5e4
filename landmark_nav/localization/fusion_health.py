"""Whether the filter can be believed: tracking, coasting or lost, and why."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtri

from landmark_nav.localization.fusion_update import FusionUpdate
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import PoseEstimate, Refusal

__all__ = ['Health', 'HealthConfig', 'Status']

Status = Literal['tracking', 'coasting', 'lost']


@dataclass(frozen=True)
class HealthConfig:
    """When the filter calls itself coasting or lost."""

    coasting_after_s: float = parameter(
        1.0, 'Seconds without an accepted measurement until coasting.', minimum=0.0, maximum=3600.0
    )
    lost_after_rejections: int = parameter(
        5, 'Measurements rejected in a row until lost.', minimum=1, maximum=1000
    )
    found_after_acceptances: int = parameter(
        3, 'Measurements accepted in a row until no longer lost.', minimum=1, maximum=1000
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

    def __post_init__(self) -> None:
        """Check the values."""
        check_parameters(self)


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

    def restart(self, stamp_ns: int) -> None:
        """Forget everything: a pose was given at that time."""
        self._accepted_ns = stamp_ns
        self._rejections = self._acceptances = 0
        self._astray = self._last_refusal = ''
        self._window.clear()

    @property
    def astray(self) -> bool:
        """Whether measurements have contradicted the state for so long that it is not believed."""
        return bool(self._astray)

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
            if self._acceptances >= self._config.found_after_acceptances:
                self._astray = ''
        elif update.refusal is not None:
            self.note(update.refusal)
            self._rejections += 1
            self._acceptances = 0
            if self._rejections >= self._config.lost_after_rejections:
                self._astray = (
                    f'{self._rejections} measurements rejected in a row, last: {update.refusal}'
                )
                self._window.clear()

    def status(self, estimate: PoseEstimate | None) -> tuple[Status, str]:
        """Judge the newest estimate; the reason is empty while tracking."""
        if estimate is None or self._accepted_ns is None:
            return 'lost', 'no start pose: give one on initialpose or call relocalize'
        if self._astray:
            return 'lost', self._astray
        sigma = float(np.sqrt(np.trace(estimate.covariance[:2, :2])))
        sigma_heading = float(np.sqrt(estimate.covariance[2, 2]))
        if sigma > self._config.lost_sigma_m or sigma_heading > self._config.lost_sigma_rad:
            return 'lost', f'sigma is {sigma:.2f} m and {np.degrees(sigma_heading):.1f} deg'
        nis, degrees = np.sum(self._window, axis=0) if self._window else (0.0, 0)
        repeats = min(self._config.nis_correlation, max(len(self._window), 1))
        level = 1.0 - self._config.nis_probability
        limit = repeats * float(chdtri(max(degrees / repeats, 1.0), level))
        if nis > limit:
            return 'lost', (
                f'innovations are too large: NIS {nis:.0f} over the last {len(self._window)} '
                f'measurements, limit {limit:.0f}'
            )
        waited = (estimate.stamp_ns - self._accepted_ns) * 1e-9
        if waited > self._config.coasting_after_s:
            return 'coasting', f'nothing accepted for {waited:.1f} s{self._last_refusal}'
        return 'tracking', ''
