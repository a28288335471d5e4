"""Whether the clock of the odometry was set, or its samples only come late or after a pause."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from landmark_nav.types import Refusal

__all__ = ['Ahead', 'ClockStep', 'ClockWatch']

# A sample that is older by this is not late; one that is newer may be wrong.
_STEP_NS = 10**9
# So many late samples in a row, in the order of their stamps, also mean that it was set back.
_LATE_IN_A_ROW = 5


@dataclass(frozen=True)
class Ahead(Refusal):
    """Why a sample is held back, which may be wrong or the first after a pause."""


class ClockStep(Enum):
    """What a stamp says about the clock."""

    NONE = 'goes on'
    AHEAD = 'is ahead'
    BACK = 'was set back'


class ClockWatch:
    """Judges stamps in the order of their arrival."""

    def __init__(self) -> None:
        """Know of no stamp yet."""
        self._late_ns = self._late_in_a_row = 0
        self._ahead_ns: int | None = None

    def judge(self, stamp_ns: int, odometry_ns: int, newest_ns: int, window_ns: int) -> ClockStep:
        """
        Return what the stamp of a sample says.

        `odometry_ns` is the newest stamp of the odometry, `newest_ns` that of all; what is older
        by less than `window_ns` may be late. A sample that is far ahead is to be left out: if the
        next one follows it, there was a pause.
        """
        late = stamp_ns <= odometry_ns
        in_order = late and stamp_ns > self._late_ns
        self._late_in_a_row = self._late_in_a_row + 1 if in_order else 0
        self._late_ns = stamp_ns if late else 0
        if self._late_in_a_row >= _LATE_IN_A_ROW or stamp_ns < newest_ns - max(
            window_ns, _STEP_NS
        ):
            self._late_in_a_row = 0
            return ClockStep.BACK
        before, self._ahead_ns = self._ahead_ns, None
        if stamp_ns - odometry_ns <= _STEP_NS or (
            before is not None and 0 < stamp_ns - before <= before - odometry_ns
        ):
            return ClockStep.NONE
        self._ahead_ns = stamp_ns
        return ClockStep.AHEAD
