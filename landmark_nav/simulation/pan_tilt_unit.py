"""A pan-tilt unit with limits, an elastic head and encoders, and its control on a drive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import transform_points
from landmark_nav.parameters import Config
from landmark_nav.simulation.scene import item_points, Scene, view_quality
from landmark_nav.types import FloatArray

# Largest time step of the integration of the spring.
_SPRING_STEP_S = 1.0 / 400.0


@dataclass(frozen=True)
class PanTiltConfig(Config):
    """Limits, dynamics and resolution of the unit."""

    max_rate_rad_s: float = 2.1
    max_acceleration_rad_s2: float = 8.0
    pan_limit_rad: float = float(np.pi)
    tilt_limit_rad: float = 0.6
    # Natural frequency of the head, which oscillates after a stop.
    natural_frequency_hz: float = 6.0
    damping_ratio: float = 0.4
    encoder_step_rad: float = 0.0002


class PanTiltUnit:
    """
    Pan and tilt axes that follow commands.

    The motors have trapezoidal velocity profiles. The head is connected to them by a spring, so
    that it oscillates after each stop. The encoders measure the head.
    """

    def __init__(self, config: PanTiltConfig) -> None:
        """Start at rest at pan and tilt 0."""
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
        """Pan and tilt measured by the encoders, (2,)."""
        step = self._config.encoder_step_rad
        return np.array(np.rint(self._head / step) * step if step > 0.0 else self._head)

    @property
    def settled(self) -> bool:
        """Whether the head is at rest at the commanded angles."""
        there = np.abs(self._head - self._goal).max() < 5e-4
        return bool(there and np.abs(self._head_rate).max() < 2e-3)

    def command(self, pan_rad: float, tilt_rad: float = 0.0) -> None:
        """Turn to angles at the largest rate; angles are clipped to the limits."""
        self._goal = np.clip([pan_rad, tilt_rad], -self._limit, self._limit)

    def jump(self, pan_rad: float, tilt_rad: float = 0.0) -> None:
        """Set the angles at once, at rest; for the start of a simulation."""
        self.command(pan_rad, tilt_rad)
        self._motor, self._head = self._goal.copy(), self._goal.copy()
        self._motor_rate, self._head_rate = np.zeros(2), np.zeros(2)

    def step(self, dt_s: float) -> None:
        """Advance the time."""
        config = self._config
        error = self._goal - self._motor
        # The largest rate that allows to stop at the goal and does not overshoot in this step.
        rate = np.sqrt(2.0 * config.max_acceleration_rad_s2 * np.abs(error))
        rate = np.minimum(np.minimum(rate, config.max_rate_rad_s), np.abs(error) / dt_s)
        change = np.sign(error) * rate - self._motor_rate
        usual = config.max_acceleration_rad_s2 * dt_s
        # The last step to the goal may have a larger acceleration, so that the motor stops there.
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


# Distance of chosen pans from the limits, so that the camera can follow while the base turns.
_RESERVE_RAD = 0.4
# Largest angle of incidence of an item.
_STEEPEST_DEG = 58.0
# Nearer items fill the image, so that few others are in view, and look unlike when learned.
_NEAR_M = 1.9
# Below this quality, an item is abandoned for a better one.
_LOST_QUALITY = 0.2
# Items within this angle of each other are in view together.
_TOGETHER_RAD = 0.35
# Preferred smallest angle between an item and the next one.
_ELSEWHERE_RAD = 0.6


class PanControl:
    """
    Points the camera at one random item for some time, then chooses another.

    Items of the scene that are `preferred` (n,), such as known landmarks, are chosen more often.
    """

    def __init__(
        self,
        scene: Scene,
        mount: PanTiltMount,
        pan_limit_rad: float,
        rng: np.random.Generator,
        preferred: npt.NDArray[np.bool_] | None = None,
    ) -> None:
        self._scene = scene
        self._mount = mount
        self._limit_rad = pan_limit_rad
        self._rng = rng
        self._points, self._walls = item_points(scene)
        known = np.ones(len(self._points), np.bool_) if preferred is None else preferred
        self._liking = np.where(known, 1.0, 0.1)
        self._chosen = -1
        self._until_s = 0.0

    def pan(self, time_s: float, pose_map_base: FloatArray) -> float:
        """Pan toward the current item from a pose (3,); 0 if there is none."""
        axis = transform_points(pose_map_base, self._mount.axis_xyz[:2])
        offset = self._points[:, :2] - axis
        azimuth = np.arctan2(offset[:, 1], offset[:, 0]) - pose_map_base[2]
        pan = self._mount.pan_toward_rad(azimuth)
        usable = np.abs(pan) < self._limit_rad - _RESERVE_RAD
        quality = np.where(usable, self._quality(axis), 0.0)
        # The item is lost if it is hidden, or of low quality while a better one is in view.
        now = float(quality[self._chosen]) if self._chosen >= 0 else 0.0
        if now == 0.0 or now < _LOST_QUALITY <= quality.max() or time_s >= self._until_s:
            self._choose(time_s, pan, quality)
        return float(pan[self._chosen]) if self._chosen >= 0 else 0.0

    def _quality(self, axis_xy: FloatArray) -> FloatArray:
        seen = view_quality(self._scene, axis_xy, self._points, self._walls, _STEEPEST_DEG)[0]
        near = np.linalg.norm(self._points[:, :2] - axis_xy, axis=1) < _NEAR_M
        return np.asarray(np.where(near, 0.1 * seen, seen))

    def _choose(self, time_s: float, pan: npt.NDArray[np.float64], quality: FloatArray) -> None:
        """Choose an item, preferably one with other visible items around it."""
        together = np.abs(wrap_rad(pan[:, None] - pan)) < _TOGETHER_RAD
        weight = np.where(quality > 0.0, together @ (quality * self._liking), 0.0) ** 2
        if self._chosen >= 0:
            # Prefer items in other directions.
            near = np.abs(wrap_rad(pan - pan[self._chosen])) < _ELSEWHERE_RAD
            weight = weight * np.where(near, 0.02, 1.0)
            weight[self._chosen] = 0.0
        self._until_s = time_s + float(self._rng.uniform(1.8, 3.2))
        if weight.sum() <= 0.0:
            return
        self._chosen = int(self._rng.choice(len(weight), p=weight / weight.sum()))
