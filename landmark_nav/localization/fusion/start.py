"""A pose from which the filter starts anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.fusion.state import FilterState, HEADING, with_late_joints
from landmark_nav.localization.fusion.turn import LATE_S
from landmark_nav.types import PoseEstimate

__all__ = ['checked_start', 'is_finite', 'is_headed', 'with_joints_in_doubt']

# Sigmas of x, y, heading of a pose that is not known. Those who tell that by larger numbers leave
# no digits for what is found.
_UNKNOWN = np.array([100.0, 100.0, np.pi])
# Heading sigma that pictures give at worst while the pan stands still.
_HEADED_RAD = 0.02
# If dead reckoning gives the same heading to this share of its sigma, joint states are in time.
_SAME_SHARE = 0.3


def is_finite(estimate: PoseEstimate) -> bool:
    """Whether a pose and its covariance are numbers."""
    return bool(np.isfinite(estimate.pose).all() and np.isfinite(estimate.covariance).all())


def is_headed(found: FilterState | PoseEstimate) -> bool:
    """Whether the heading is known as well as pictures tell it while the pan stands still."""
    return bool(found.covariance[HEADING, HEADING] <= _HEADED_RAD**2)


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


def with_joints_in_doubt(
    state: FilterState, found: PoseEstimate, reckoned: FilterState | None
) -> FilterState:
    """
    Return `state` with an open joint delay, if the delay may have bent the heading of `found`.

    A pose that was found while the pan turned has a wide heading, as late joint states would turn
    it. Nothing is to be opened if the delay was measured before, or if dead reckoning to the same
    time, `reckoned`, has the same heading.
    """
    if is_headed(found) or (state.late.sigma_s > 0.0 and state.late.is_known):
        return state
    if reckoned is not None:
        away = wrap_rad(found.pose[HEADING] - reckoned.mean[HEADING])
        variances = reckoned.covariance[HEADING, HEADING], found.covariance[HEADING, HEADING]
        if away**2 + variances[0] < _SAME_SHARE**2 * variances[1]:
            return state
    return with_late_joints(state, LATE_S)
