"""Where a camera looks that does not know where it is: all around, view by view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.parameters import Config, parameter
from landmark_nav.types import PoseEstimate

# What two views that follow each other share, of their width.
_OVERLAP = 0.25
# A joint that is so near has arrived.
_ARRIVED_RAD = 0.03
# A joint that has not arrived by then, s, is left where it is stuck.
_PATIENCE_S = 5.0

# Sigmas from which a pose is not known: of the position (root of the trace), of the heading.
_LOST_SIGMA_M = 0.5
_LOST_SIGMA_RAD = 0.5


@dataclass(frozen=True)
class LookAroundConfig(Config):
    """When the camera looks around for the place, and how long at each view."""

    enabled: bool = parameter(
        True, 'turn the camera all around, view by view, where the pose is not known'
    )
    # How long the pose must not have been known before, s.
    after_s: float = 2.0
    # How long the camera rests at each view, s.
    dwell_time_s: float = 0.5


def is_known(pose: PoseEstimate) -> bool:
    """Whether a pose is known well enough to choose where to look."""
    variance = np.diag(pose.covariance)
    return bool(
        variance[0] + variance[1] <= _LOST_SIGMA_M**2 and variance[2] <= _LOST_SIGMA_RAD**2
    )


def views_around(
    limits_rad: tuple[float, float], fov_rad: float, pan_rad: float
) -> tuple[float, ...]:
    """
    Pans that together see all that the joint reaches, each once, within its limits.

    They begin at the one next to `pan_rad` and go on to the nearer end, then over the others.
    """
    low, high = limits_rad
    step = (1.0 - _OVERLAP) * fov_rad
    # A full turn ends where it began.
    spare = max(0.0, high - low - (2.0 * np.pi - step))
    low, high = low + 0.5 * spare, high - 0.5 * spare
    pans = np.linspace(low, high, int(np.ceil((high - low) / step - 1e-9)) + 1)
    first = int(np.argmin(np.abs(pans - pan_rad)))
    below, above = pans[:first][::-1], pans[first:]
    if len(below) < len(above) - 1:
        below, above = pans[first + 1 :], pans[: first + 1][::-1]
    return tuple(map(float, (*above, *below)))


class LookAround:
    """Leads the camera around for as long as the pose is not known."""

    def __init__(self, config: LookAroundConfig, limits_rad: tuple[float, float]) -> None:
        self._config, self._limits = config, limits_rad
        self._left: list[float] = []
        self._target: float | None = None
        self._since_s: float | None = None  # when the pose was known last
        self._turned_s = self._arrived_s = 0.0

    def end(self) -> None:
        """The pose is known, or somebody else turns the camera."""
        self._left, self._target, self._since_s = [], None, None

    def pan_at(self, now_s: float, pan_rad: float, fov_rad: float) -> float | None:
        """
        Where to turn while the pose is not known; None before that has lasted long enough.

        Parameters
        ----------
        now_s : float
            Time by a clock that is never set.
        """
        if self._since_s is None:
            self._since_s = now_s
        if not self._config.enabled or now_s - self._since_s < self._config.after_s:
            return None
        if self._target is None or self._seen(now_s, pan_rad):
            self._left = self._left or list(views_around(self._limits, fov_rad, pan_rad))
            self._target = self._left.pop(0)
            self._turned_s = self._arrived_s = now_s
        return self._target

    def _seen(self, now_s: float, pan_rad: float) -> bool:
        """Whether the camera has rested at its target for long enough, or will not reach it."""
        assert self._target is not None
        if abs(pan_rad - self._target) > _ARRIVED_RAD:
            self._arrived_s = now_s
            return now_s - self._turned_s >= _PATIENCE_S
        return now_s - self._arrived_s >= self._config.dwell_time_s
