"""What belongs to one step of a sweep."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

import numpy as np

from landmark_nav.learning.capture.frames import KeptFrame, Shot

__all__ = ['Phase', 'Step']

FrameT = TypeVar('FrameT')


class Phase(Enum):
    """What a step waits for."""

    SETTLING = 'the pan joint to stand at the commanded angle'
    EXPOSING = 'an image'
    CONFIRMING = 'a joint sample later than the image'


@dataclass
class Step(Generic[FrameT]):
    """
    The step under way; stamps are the robot's, other times the caller's.

    `number` is None while nothing is left but to see that the joint can still move.
    """

    number: int | None
    target_rad: float
    shots: list[KeptFrame[FrameT]]
    progress_ns: int
    begin_stamp_ns: int | None
    progress_stamp_ns: int
    phase: Phase = Phase.SETTLING
    pending: Shot[FrameT] | None = None
    refusals: int = 0
    commanded_ns: int | None = None
    settled_stamp_ns: int = 0
    again_ns: int = 0
    distance_rad: float = float(np.inf)
