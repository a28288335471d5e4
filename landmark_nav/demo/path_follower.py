"""Speeds that lead a differential drive along a path: pure pursuit."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import inverse, transform_points
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import FloatArray

__all__ = ['FollowerConfig', 'PathFollower']

_STEP_M = 0.02


@dataclass(frozen=True)
class FollowerConfig:
    """How a path is driven."""

    speed_m_s: float = parameter(0.3, 'speed on the straight, m/s', minimum=0.01, maximum=2.0)
    rate_rad_s: float = parameter(0.8, 'largest turn rate, rad/s', minimum=0.05, maximum=4.0)
    lookahead_m: float = parameter(0.35, 'distance of the point aimed at, m', minimum=0.05)
    goal_m: float = parameter(0.08, 'distance from the end that counts as there, m', minimum=0.01)
    turn_on_spot_rad: float = parameter(
        0.8, 'bearing of the point aimed at beyond which it only turns, rad', minimum=0.1
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_parameters(self)


class PathFollower:
    """
    Follows a polyline once, from its start to its end.

    Coulter, Implementation of the Pure Pursuit Path Tracking Algorithm, CMU-RI-TR-92-01.

    Parameters
    ----------
    path : array_like, shape (n, 2)
        Corners in the frame of the poses it will be given, metres.
    config : FollowerConfig
        Speeds and distances.

    """

    def __init__(self, path: npt.ArrayLike, config: FollowerConfig | None = None) -> None:
        self._config = config or FollowerConfig()
        self._path = _densified(np.asarray(path, dtype=np.float64))
        self._reached = 0

    @property
    def progress(self) -> float:
        """Share of the path that lies behind, 0 to 1."""
        return self._reached / max(len(self._path) - 1, 1)

    def speeds(self, pose: FloatArray) -> tuple[float, float] | None:
        """Speed [m/s] and turn rate [rad/s] at `pose` (3,); None at the end of the path."""
        config = self._config
        # Only look a little ahead for the nearest point: a path may cross itself.
        window = self._path[self._reached : self._reached + int(2 * config.lookahead_m / _STEP_M)]
        away = np.linalg.norm(window - pose[:2], axis=1)
        self._reached += int(np.argmin(away))
        if np.linalg.norm(self._path[-1] - pose[:2]) < config.goal_m and self.progress > 0.9:
            return None
        ahead = self._reached + int(config.lookahead_m / _STEP_M)
        target = self._path[min(ahead, len(self._path) - 1)]
        x, y = transform_points(inverse(pose), target)
        bearing = float(wrap_rad(np.arctan2(y, x)))
        if abs(bearing) > config.turn_on_spot_rad:
            return 0.0, float(np.copysign(config.rate_rad_s, bearing))
        curvature = 2.0 * y / max(x * x + y * y, 1e-3)
        left_m = (len(self._path) - 1 - self._reached) * _STEP_M
        speed = config.speed_m_s * float(np.clip(left_m / config.lookahead_m, 0.3, 1.0))
        rate = float(np.clip(curvature * speed, -config.rate_rad_s, config.rate_rad_s))
        # Where the turn is at its limit, drive slower to keep the curve.
        if abs(curvature * speed) > config.rate_rad_s:
            speed = config.rate_rad_s / abs(curvature)
        return speed, rate


def _densified(corners: FloatArray) -> FloatArray:
    pieces = [corners[:1]]
    for start, end in pairwise(corners):
        count = max(int(np.ceil(np.linalg.norm(end - start) / _STEP_M)), 1)
        share = np.arange(1, count + 1)[:, None] / count
        pieces.append(start + share * (end - start))
    return np.concatenate(pieces)
