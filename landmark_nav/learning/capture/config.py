"""Parameters of a sweep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.parameters import Config, parameter
from landmark_nav.types import FloatArray


@dataclass(frozen=True)
class CaptureConfig(Config):
    """
    How a sweep is captured.

    By default 72 frames, 5 degrees apart, are a full turn; chosen by hand.
    """

    start_rad: float = parameter(
        -np.pi, 'pan of the first frame', minimum=-2 * np.pi, maximum=2 * np.pi
    )
    step_rad: float = parameter(
        float(np.radians(5.0)),
        'pan from one frame to the next; its sign is the direction',
        minimum=-1.0,
        maximum=1.0,
    )
    frames: int = parameter(72, 'frames of a sweep', minimum=1, maximum=1440)
    # Limits of the pan joint; steps beyond them are left out.
    pan_min_rad: float = -np.pi
    pan_max_rad: float = np.pi
    # Distance from the commanded pan that counts as arrived, rad.
    arrival_tolerance_rad: float = 0.01
    step_timeout_s: float = parameter(
        5.0,
        'time without getting nearer to the next frame before giving up',
        minimum=0.1,
        maximum=600.0,
    )
    # Largest number of refused frames in one step.
    retakes: int = 10
    # Pause before a frame is taken again, s.
    retake_pause_s: float = 0.2
    # Largest difference between the stamps of an image and of joint states, s.
    stamp_gap_s: float = 0.3

    def __post_init__(self) -> None:
        """Check that the joint can reach at least one of the steps."""
        super().__post_init__()
        if np.isnan(self.targets(self.pan_min_rad, self.pan_max_rad)).all():
            last = self.start_rad + (self.frames - 1) * self.step_rad
            raise LandmarkNavError(
                f'a sweep from {np.degrees(self.start_rad):.1f} to {np.degrees(last):.1f} deg has '
                f"no frame within the joint's {np.degrees(self.pan_min_rad):.1f} to "
                f'{np.degrees(self.pan_max_rad):.1f} deg: change start_rad, step_rad or frames'
            )

    def targets(self, low_rad: float, high_rad: float) -> FloatArray:
        """
        Pan of each step, (frames,), shifted by whole turns into two limits; NaN if impossible.

        If several turns are possible, the pan is the nearest to `start_rad` + k `step_rad`.
        """
        wanted = self.start_rad + self.step_rad * np.arange(self.frames)
        reached = np.full(self.frames, np.nan)
        slack = 1e-6
        most = int(np.ceil(np.abs(wanted).max() / (2.0 * np.pi))) + 2
        for turns in sorted(range(-most, most + 1), key=abs, reverse=True):
            pan = wanted + turns * 2.0 * np.pi
            inside = (pan >= low_rad - slack) & (pan <= high_rad + slack)
            reached[inside] = np.clip(pan[inside], low_rad, high_rad)
        return reached
