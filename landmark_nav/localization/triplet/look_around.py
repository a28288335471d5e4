"""Where the camera looks while the pose is unknown: all around, view by view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.parameters import Config, parameter
from landmark_nav.types import PoseEstimate

# Overlap of consecutive views, relative to their width.
_OVERLAP = 0.25
# A joint this near to its target has arrived.
_ARRIVED_RAD = 0.03
# A joint that has not arrived after this time, s, is stuck: the next view follows.
_PATIENCE_S = 5.0
# A pose with larger sigmas is unknown: of the position (root of the trace), of the heading.
_LOST_SIGMA_M = 0.5
_LOST_SIGMA_RAD = 0.5


@dataclass(frozen=True)
class LookAroundConfig(Config):
    """When the camera looks around, and how long at each view."""

    enabled: bool = parameter(
        True, 'turn the camera all around, view by view, where the pose is not known'
    )
    # Time for which the pose must have been unknown before, s.
    after_s: float = 2.0
    # Time at each view, s.
    dwell_time_s: float = 0.5


def is_known(pose: PoseEstimate) -> bool:
    """Whether a pose is certain enough to choose triplets by it."""
    variance = np.diag(pose.covariance)
    return bool(
        variance[0] + variance[1] <= _LOST_SIGMA_M**2 and variance[2] <= _LOST_SIGMA_RAD**2
    )


def views_around(
    limits_rad: tuple[float, float], fov_rad: float, pan_rad: float
) -> tuple[float, ...]:
    """
    Pans that together cover all that the joint can reach.

    The first is the one nearest to `pan_rad`; then come those up to the nearer limit, then the
    others.
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
    """Turns the camera from view to view while the pose is unknown."""

    def __init__(self, config: LookAroundConfig, limits_rad: tuple[float, float]) -> None:
        self._config, self._limits = config, limits_rad
        self._left: list[float] = []
        self._target: float | None = None
        self._since_s: float | None = None  # since when the pose is unknown
        self._turned_s = self._arrived_s = 0.0

    def end(self) -> None:
        """Stop: the pose is known, or something else turns the camera."""
        self._left, self._target, self._since_s = [], None, None

    def pan_at(self, now_s: float, pan_rad: float, fov_rad: float) -> float | None:
        """Pan to turn to while the pose is unknown; None until that has lasted for `after_s`."""
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
        """Whether the camera has rested at its target long enough, or is stuck."""
        assert self._target is not None
        if abs(pan_rad - self._target) > _ARRIVED_RAD:
            self._arrived_s = now_s
            return now_s - self._turned_s >= _PATIENCE_S
        return now_s - self._arrived_s >= self._config.dwell_time_s
