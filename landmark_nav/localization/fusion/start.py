"""A pose from which the filter starts anew."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.pan_track import PanTrack
from landmark_nav.localization.fusion.state import FilterState, HEADING
from landmark_nav.localization.joint_delay import DELAY_BOUND_S, JointDelay, PanError
from landmark_nav.types import PoseEstimate

__all__ = ['Found', 'is_headed', 'joints_in_doubt']

# Heading sigma that images give at worst while the pan stands still.
_HEADED_RAD = 0.02
# A pan that turns no more than this meanwhile stands still.
_STEADY_RAD = 0.005
# If dead reckoning gives the same heading to this share of its sigma, joint states are in time.
_SAME_SHARE = 0.3


def is_headed(found: FilterState) -> bool:
    """Whether the heading is known as well as images tell it while the pan stands still."""
    return bool(found.covariance[HEADING, HEADING] <= _HEADED_RAD**2)


class Found(NamedTuple):
    """
    How a pose was found: `witnesses` (m,), the ids of the landmarks, and where the camera looked.

    The pan of the last image, with its rate and track as azimuths in ``base_link``, was put
    right for joint states that are late by `pan_delay_s`, as far as that was known.
    """

    witnesses: npt.NDArray[np.int64]
    pan_rate_rad_s: float = 0.0
    pan_track: PanTrack | None = None
    pan_delay_s: float = 0.0

    def lag(self, late: JointDelay) -> PanError:
        """By how much the pan was off with joint states that are so late."""
        return late.lag(self.pan_rate_rad_s, self.pan_track, self.pan_delay_s)

    def pan_range_rad(self, seconds: float) -> float:
        """How far the pan turned, at most, so much before and after."""
        delays = (JointDelay(self.pan_delay_s + s) for s in (-seconds, seconds))
        return max(abs(self.lag(late).shift_rad) for late in delays)


def joints_in_doubt(
    start: PoseEstimate, found: Found, late: JointDelay, reckoned: FilterState | None
) -> bool:
    """
    Whether late joint states may have turned the heading of a pose that was found.

    They turn it as far as the pan turned meanwhile. They are not in doubt if `late` was measured
    before, or if dead reckoning to the same time, `reckoned`, has the same heading.
    """
    pan_range_rad = found.pan_range_rad(DELAY_BOUND_S)
    variance = start.covariance[HEADING, HEADING] + pan_range_rad**2
    if late.sigma_s > 0.0 and late.is_known:
        return False
    if variance <= _HEADED_RAD**2 and pan_range_rad <= _STEADY_RAD:
        return False
    if reckoned is not None:
        away = wrap_rad(start.pose[HEADING] - reckoned.mean[HEADING])
        if away**2 + reckoned.covariance[HEADING, HEADING] < _SAME_SHARE**2 * variance:
            return False
    return True
