"""A pan-tilt unit: limits of rate and acceleration, a springy head, encoder steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.parameters import Config
from landmark_nav.types import FloatArray

# The spring is integrated in steps no longer than this.
_SPRING_STEP_S = 1.0 / 400.0


@dataclass(frozen=True)
class PanTiltConfig(Config):
    """How quickly and how exactly the unit turns."""

    # Largest rate of an axis.
    max_rate_rad_s: float = 2.1
    # Largest acceleration of an axis.
    max_acceleration_rad_s2: float = 8.0
    # Pan goes this far to both sides.
    pan_limit_rad: float = float(np.pi)
    # Tilt goes this far up and down.
    tilt_limit_rad: float = 0.6
    # Of the head that oscillates after a stop.
    natural_frequency_hz: float = 6.0
    # Of that swinging.
    damping_ratio: float = 0.4
    # Step of the measured angles.
    encoder_step_rad: float = 0.0002


class PanTiltUnit:
    """
    Two axes that follow commands.

    The motors move along trapezoidal profiles; the head follows them through a spring, so that it
    oscillates a little after each stop. Encoders sit at the head.
    """

    def __init__(self, config: PanTiltConfig) -> None:
        """Stand still, looking ahead."""
        self._config = config
        self._limit = np.array([config.pan_limit_rad, config.tilt_limit_rad])
        self._goal = np.zeros(2)
        self._motor = np.zeros(2)
        self._motor_rate = np.zeros(2)
        self._head: FloatArray = np.zeros(2)
        self._head_rate = np.zeros(2)

    @property
    def angles_rad(self) -> FloatArray:
        """True pan and tilt, (2,)."""
        return np.array(self._head)

    @property
    def measured_rad(self) -> FloatArray:
        """Pan and tilt as the encoders give them, (2,)."""
        step = self._config.encoder_step_rad
        return np.array(np.rint(self._head / step) * step if step > 0.0 else self._head)

    @property
    def settled(self) -> bool:
        """Whether the last command has been carried out and the head has come to rest."""
        there = np.abs(self._head - self._goal).max() < 5e-4
        return bool(there and np.abs(self._head_rate).max() < 2e-3)

    def command(self, pan_rad: float, tilt_rad: float = 0.0) -> None:
        """Turn there as quickly as allowed; angles beyond the limits are cut to them."""
        self._goal = np.clip([pan_rad, tilt_rad], -self._limit, self._limit)

    def jump(self, pan_rad: float, tilt_rad: float = 0.0) -> None:
        """Be there at once and at rest: how a simulation starts."""
        self.command(pan_rad, tilt_rad)
        self._motor, self._head = self._goal.copy(), self._goal.copy()
        self._motor_rate, self._head_rate = np.zeros(2), np.zeros(2)

    def step(self, dt_s: float) -> None:
        """Let time pass."""
        config = self._config
        error = self._goal - self._motor
        # The rate from which one can just stop at the goal, and no further than the goal.
        rate = np.sqrt(2.0 * config.max_acceleration_rad_s2 * np.abs(error))
        rate = np.minimum(np.minimum(rate, config.max_rate_rad_s), np.abs(error) / dt_s)
        change = np.sign(error) * rate - self._motor_rate
        usual = config.max_acceleration_rad_s2 * dt_s
        # Stopping right at the goal may take more: less than one step's worth of rate.
        most = np.where(np.abs(error) < usual * dt_s, np.inf, usual)
        self._motor_rate = self._motor_rate + np.clip(change, -most, most)
        start = self._motor
        self._motor = self._motor + self._motor_rate * dt_s
        omega = 2.0 * np.pi * config.natural_frequency_hz
        steps = int(np.ceil(dt_s / _SPRING_STEP_S))
        for k in range(1, steps + 1):
            motor = start + (self._motor - start) * (k / steps)
            pull = omega**2 * (motor - self._head)
            drag = 2.0 * config.damping_ratio * omega * (self._motor_rate - self._head_rate)
            self._head_rate = self._head_rate + (pull + drag) * (dt_s / steps)
            self._head = self._head + self._head_rate * (dt_s / steps)
