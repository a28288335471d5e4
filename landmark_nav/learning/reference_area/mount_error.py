"""A mount that papers show to be otherwise than given."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.types import FloatArray

__all__ = ['MountError', 'WrongMountError']

# What a person may be off by; more is another mistake.
_MOST_M, _MOST_RAD = 0.3, float(np.radians(10.0))


@dataclass(frozen=True, eq=False)
class MountError:
    """
    How much higher the camera is than given, and how its pan axis tilts, about.

    `tilt_roll_rad` (2,) is about x and y of the base.
    """

    rise_m: float = 0.0
    tilt_roll_rad: FloatArray = field(default_factory=lambda: np.zeros(2))

    @property
    def reasonable(self) -> bool:
        """Whether a person with a tape and a spirit level may be off by it."""
        return abs(self.rise_m) < _MOST_M and float(np.hypot(*self.tilt_roll_rad)) < _MOST_RAD


class WrongMountError(LandmarkNavError):
    """Papers fit a mount that is off by `found` from the given one."""

    def __init__(self, message: str, found: MountError) -> None:
        super().__init__(message)
        self.found = found
