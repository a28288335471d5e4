"""A pose from which the filter starts anew."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.pan_track import PanTrack
from landmark_nav.localization.fusion.state import FilterState, HEADING
from landmark_nav.localization.joint_delay import DELAY_BOUND_S, JointDelay, PanError
from landmark_nav.types import PoseEstimate

__all__ = ['Found', 'checked_start', 'is_finite', 'is_headed', 'joints_in_doubt', 'with_sigmas']

# Sigmas of x, y, heading of a pose that is not known. Those who tell that by larger numbers leave
# no digits for what is found.
_UNKNOWN = np.array([100.0, 100.0, np.pi])
# Heading sigma that images give at worst while the pan stands still.
_HEADED_RAD = 0.02
# A pan that turns no more than this meanwhile stands still.
_STEADY_RAD = 0.005
# If dead reckoning gives the same heading to this share of its sigma, joint states are in time.
_SAME_SHARE = 0.3


def is_finite(estimate: PoseEstimate) -> bool:
    """Whether a pose and its covariance are numbers."""
    return bool(np.isfinite(estimate.pose).all() and np.isfinite(estimate.covariance).all())


def is_headed(found: FilterState) -> bool:
    """Whether the heading is known as well as images tell it while the pan stands still."""
    return bool(found.covariance[HEADING, HEADING] <= _HEADED_RAD**2)


def with_sigmas(start: PoseEstimate, sigma_m: float, sigma_rad: float) -> PoseEstimate:
    """Return a start with these sigmas of position and heading where its variances are zero."""
    variance = np.square([sigma_m, sigma_m, sigma_rad])
    missing = np.where(start.covariance.diagonal() == 0.0, variance, 0.0)
    return replace(start, covariance=start.covariance + np.diag(missing))


def checked_start(
    start: PoseEstimate, odometry_ns: tuple[int, int] | None, now_ns: int | None
) -> PoseEstimate:
    """
    Return a valid start pose; its stamp is replaced by now if no odometry is near it.

    Its sigmas are those of a pose that is not known at most, 100 m and half a turn.

    Parameters
    ----------
    start : PoseEstimate
        As it was given.
    odometry_ns : tuple of int or None
        First and last stamp of the odometry.
    now_ns : int or None
        Present time; the last odometry's if that is later.

    Raises
    ------
    LandmarkNavError
        A pose or covariance that is not finite, or a covariance that is not positive.

    """
    if not is_finite(start):
        raise LandmarkNavError('start pose: x, y, heading or covariance is not a number')
    sigmas = np.sqrt(np.maximum(start.covariance.diagonal(), 0.0))
    share = _UNKNOWN / np.maximum(sigmas, _UNKNOWN)
    start = replace(start, covariance=start.covariance * np.outer(share, share))
    if np.linalg.eigvalsh(start.covariance)[0] < -1e-9:
        raise LandmarkNavError('start pose: its covariance is not positive semidefinite')
    if odometry_ns is None:
        return start
    now_ns = max(odometry_ns[1], now_ns or 0)
    if odometry_ns[0] <= start.stamp_ns <= max(now_ns, odometry_ns[1] + 10**9):
        return start
    return replace(start, stamp_ns=now_ns)


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
