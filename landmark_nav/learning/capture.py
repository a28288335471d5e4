"""
Taking a sweep: turn the camera step by step, let it settle, keep one frame, go on.

Event-driven and free of clocks: the caller reports joint samples and frame stamps as they come
and asks for the next command. Arrival and settling are seen in the joint angles; the time limits
only serve to give up with a reason.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import JointSample

__all__ = ['CaptureConfig', 'KeptFrame', 'SweepCapture']

FrameT = TypeVar('FrameT')

_HISTORY = 200


@dataclass(frozen=True)
class CaptureConfig:
    """How a sweep is taken."""

    start_rad: float = parameter(
        -np.pi, 'pan of the first frame, rad', minimum=-2 * np.pi, maximum=2 * np.pi
    )
    step_rad: float = parameter(
        float(np.radians(5.0)),
        'pan from one frame to the next, rad; its sign is the direction',
        minimum=-1.0,
        maximum=1.0,
    )
    frames: int = parameter(72, 'frames of a sweep', minimum=1, maximum=1440)
    pan_min_rad: float = parameter(-np.pi, 'least pan of the joint, rad', maximum=0.0)
    pan_max_rad: float = parameter(np.pi, 'largest pan of the joint, rad', minimum=0.0)
    arrival_tolerance_rad: float = parameter(
        0.01, 'distance from the commanded pan that counts as arrived, rad', minimum=1e-5
    )
    settled_samples: int = parameter(
        4, 'joint samples in a row that must stand still', minimum=2, maximum=_HISTORY
    )
    settled_velocity_rad_s: float = parameter(
        0.01, 'pan rate over those samples that counts as standing still, rad/s', minimum=1e-5
    )
    step_timeout_s: float = parameter(
        5.0, 'time for one step (turn, settle, frame) before giving up, s', minimum=0.1
    )

    def __post_init__(self) -> None:
        """Check that the joint can reach every angle."""
        check_parameters(self)
        last = self.start_rad + (self.frames - 1) * self.step_rad
        low, high = min(self.start_rad, last), max(self.start_rad, last)
        slack = 1e-6
        if low < self.pan_min_rad - slack or high > self.pan_max_rad + slack:
            raise LandmarkNavError(
                f'a sweep from {np.degrees(low):.1f} to {np.degrees(high):.1f} deg does not fit '
                f"the joint's {np.degrees(self.pan_min_rad):.1f} to "
                f'{np.degrees(self.pan_max_rad):.1f} deg: change start_rad, step_rad or frames'
            )


@dataclass(frozen=True)
class KeptFrame(Generic[FrameT]):
    """A frame of the sweep with the pan measured at its stamp."""

    frame: FrameT
    joints: JointSample


class _Phase(Enum):
    SETTLING = 'the pan joint to stand at the commanded angle'
    EXPOSING = 'an image'
    CONFIRMING = 'a joint sample later than the image'


class SweepCapture(Generic[FrameT]):
    """
    One sweep under way.

    Parameters
    ----------
    config : CaptureConfig
        Angles and tolerances.
    now_ns : int
        The caller's clock; only differences count, so it need not be that of the stamps.

    """

    def __init__(self, config: CaptureConfig, now_ns: int) -> None:
        self._config = config
        self._kept: list[KeptFrame[FrameT]] = []
        self._joints: deque[JointSample] = deque(maxlen=_HISTORY)
        self._pending: tuple[FrameT, int] | None = None
        self._phase = _Phase.SETTLING
        self._begin_step(now_ns)

    @property
    def kept(self) -> tuple[KeptFrame[FrameT], ...]:
        """Frames so far, in the order they were taken."""
        return tuple(self._kept)

    @property
    def done(self) -> bool:
        """Whether the sweep is complete."""
        return len(self._kept) == self._config.frames

    @property
    def target_rad(self) -> float:
        """Pan to command now."""
        step = min(len(self._kept), self._config.frames - 1)
        pan = self._config.start_rad + step * self._config.step_rad
        return float(np.clip(pan, self._config.pan_min_rad, self._config.pan_max_rad))

    def add_joints(self, sample: JointSample, now_ns: int) -> KeptFrame[FrameT] | None:
        """Take a joint sample; returns the frame that it confirms, if any."""
        if self.done or (self._joints and sample.stamp_ns <= self._joints[-1].stamp_ns):
            return None
        if not self._joints:
            self._first_stamp_ns = sample.stamp_ns - 1
        self._joints.append(sample)
        self._heard_ns = now_ns
        if self._phase is _Phase.SETTLING and self._stands_still():
            self._phase = _Phase.EXPOSING
            self._settled_ns = sample.stamp_ns
        elif self._phase is _Phase.CONFIRMING:
            return self._confirm(now_ns)
        return None

    def add_frame(self, frame: FrameT, stamp_ns: int) -> None:
        """Offer a frame; it is taken if the camera stood still before it was exposed."""
        if self._phase is _Phase.EXPOSING and stamp_ns > self._settled_ns:
            self._pending = (frame, stamp_ns)
            self._phase = _Phase.CONFIRMING

    def check_time(self, now_ns: int) -> None:
        """
        Give up if the present step takes too long.

        That is by the robot's own stamps too, as long as there are any: a simulator on a busy
        machine may be slow. Silence counts by the caller's clock alone.

        Raises
        ------
        LandmarkNavError
            With what was waited for and what was measured.

        """
        limit_ns = self._config.step_timeout_s * 1e9
        robot_ns = self._joints[-1].stamp_ns - self._first_stamp_ns if self._joints else 0
        silent = now_ns - self._heard_ns > limit_ns
        slow = now_ns - self._step_start_ns > limit_ns and robot_ns > limit_ns
        if self.done or not (silent or slow):
            return
        seen = 'no joint_states since then: is the pan unit on, is pan_joint its name?'
        if self._joints and self._joints[-1].stamp_ns != self._first_stamp_ns:
            seen = f'the pan is {np.degrees(self._joints[-1].pan_rad):.2f} deg'
            if self._phase is _Phase.EXPOSING:
                seen += ': is the camera on, are its stamps on the clock of joint_states?'
        raise LandmarkNavError(
            f'sweep given up at frame {len(self._kept) + 1} of {self._config.frames}, '
            f'{np.degrees(self.target_rad):.1f} deg: waited '
            f'{self._config.step_timeout_s:g} s for {self._phase.value}; {seen}'
        )

    def _begin_step(self, now_ns: int) -> None:
        self._phase = _Phase.SETTLING
        self._settled_ns = 0
        self._step_start_ns = self._heard_ns = now_ns
        self._first_stamp_ns = self._joints[-1].stamp_ns if self._joints else 0

    def _stands_still(self) -> bool:
        """Whether the last samples, all after the command, stand at the target."""
        count = self._config.settled_samples
        recent = list(self._joints)[-count:]
        if len(recent) < count or recent[0].stamp_ns <= self._first_stamp_ns:
            return False
        pan = np.array([sample.pan_rad for sample in recent])
        span_s = (recent[-1].stamp_ns - recent[0].stamp_ns) * 1e-9
        return bool(
            np.all(np.abs(pan - self.target_rad) <= self._config.arrival_tolerance_rad)
            and np.ptp(pan) <= self._config.settled_velocity_rad_s * span_s
        )

    def _confirm(self, now_ns: int) -> KeptFrame[FrameT] | None:
        """Keep the pending frame once the joint still stood after its exposure."""
        if self._pending is None or self._joints[-1].stamp_ns < self._pending[1]:
            return None
        frame, stamp_ns = self._pending
        if not self._stands_still():
            self._phase = _Phase.SETTLING
            return None
        times = [sample.stamp_ns - stamp_ns for sample in self._joints]
        kept = KeptFrame(
            frame,
            JointSample(
                stamp_ns,
                float(np.interp(0.0, times, [sample.pan_rad for sample in self._joints])),
                float(np.interp(0.0, times, [sample.tilt_rad for sample in self._joints])),
            ),
        )
        self._kept.append(kept)
        self._begin_step(now_ns)
        return kept
