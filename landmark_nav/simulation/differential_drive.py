"""A two-wheeled base and its odometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.se2 import compose
from landmark_nav.parameters import Config
from landmark_nav.types import FloatArray


@dataclass(frozen=True)
class DriveConfig(Config):
    """Limits of the base, and errors of its odometry."""

    max_speed_m_s: float = 0.8
    max_turn_rad_s: float = 1.8
    max_acceleration_m_s2: float = 1.0
    max_turn_acceleration_rad_s2: float = 4.0
    track_m: float = 0.36
    # Relative errors of each wheel radius and of the track, drawn once.
    scale_sigma: float = 0.002
    track_sigma: float = 0.008
    # Slip of each wheel over 1 m, a random walk.
    slip_sigma_m: float = 0.0015
    # Distance of a wheel for one encoder count.
    encoder_step_m: float = 0.00002


class DifferentialDrive:
    """Base with two driven wheels; it stops before positions that are not `free`."""

    def __init__(
        self,
        config: DriveConfig,
        pose_map_base: npt.ArrayLike,
        free: Callable[[FloatArray], bool],
        rng: np.random.Generator,
    ) -> None:
        """Draw the systematic errors."""
        self._config = config
        self._free = free
        self._rng = rng
        self._scale = 1.0 + config.scale_sigma * rng.standard_normal(2)
        self._track_m = config.track_m * (1.0 + config.track_sigma * rng.standard_normal())
        self._command = np.zeros(2)
        self._counted_m = np.zeros(2)
        self._rolled_m = np.zeros(2)
        self.place(pose_map_base)

    def place(self, pose_map_base: npt.ArrayLike) -> None:
        """Put the base at a pose (3,); odometry restarts from zero."""
        self.pose_map_base: FloatArray = np.array(pose_map_base, dtype=np.float64)
        self.pose_odom_base: FloatArray = np.zeros(3)
        self.twist: FloatArray = np.zeros(2)
        self.measured_twist: FloatArray = np.zeros(2)

    def command(self, linear_m_s: float, angular_rad_s: float) -> None:
        """Set the speed and turning rate to reach, clipped to the limits."""
        limit = np.array([self._config.max_speed_m_s, self._config.max_turn_rad_s])
        self._command = np.clip([linear_m_s, angular_rad_s], -limit, limit)

    def step(self, dt_s: float) -> None:
        """Advance the time."""
        config = self._config
        most = dt_s * np.array([config.max_acceleration_m_s2, config.max_turn_acceleration_rad_s2])
        self.twist = self.twist + np.clip(self._command - self.twist, -most, most)
        moved = compose(self.pose_map_base, _arc(self.twist * dt_s))
        if self.twist[0] != 0.0 and not self._free(moved[:2]):
            self.twist = np.array([0.0, self.twist[1]])
            moved = compose(self.pose_map_base, _arc(self.twist * dt_s))
        self.pose_map_base = moved
        self._measure(dt_s)

    def _measure(self, dt_s: float) -> None:
        """Update odometry by the encoder counts of the wheels."""
        config = self._config
        forward, turn = self.twist * dt_s
        rolled = forward + turn * config.track_m * np.array([-0.5, 0.5])
        slip = config.slip_sigma_m * np.sqrt(np.abs(rolled)) * self._rng.standard_normal(2)
        self._rolled_m = self._rolled_m + rolled * self._scale + slip
        counted = self._rolled_m
        if config.encoder_step_m > 0.0:
            counted = np.floor(counted / config.encoder_step_m) * config.encoder_step_m
        left, right = counted - self._counted_m
        self._counted_m = counted
        step = np.array([0.5 * (left + right), (right - left) / self._track_m])
        self.pose_odom_base = compose(self.pose_odom_base, _arc(step))
        self.measured_twist = step / dt_s


def _arc(step: FloatArray) -> FloatArray:
    """Relative pose (3,) after a distance and a turn (2,) along a circular arc."""
    way, turn = step
    # sinc is also exact for a straight line.
    chord = way * np.sinc(0.5 * turn / np.pi)
    return np.array([chord * np.cos(0.5 * turn), chord * np.sin(0.5 * turn), turn])
