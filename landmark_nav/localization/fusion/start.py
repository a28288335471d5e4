"""A pose from which to start anew, and where odometry alone led since it was believed last."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.fusion.state import (
    BORESIGHT,
    FilterState,
    HEADING,
    STATES,
    with_late_joints,
)
from landmark_nav.localization.fusion.turn import KNOCKED, LATE_S
from landmark_nav.types import FloatArray, PoseEstimate

__all__ = [
    'checked_start',
    'doubted_turn',
    'is_finite',
    'is_headed',
    'turned_since',
    'with_joints_in_doubt',
]

# A place is found with a heading at least as good as this unless the camera turns.
_TURNING_RAD = 0.02
# Part of what late joints leave open of a heading (sigmas) to which odometry tells it.
_LED_SHARE = 0.3
# Further from where odometry led than so many sigmas, and as many times so many metres, a robot
# was carried; a heading that far from it is a surprise. So many times as far as a camera may have
# been knocked it was turned: cameras are not.
_SURPRISE, _NEAR_M, _CARRIED = 3.0, 0.1, 3.0


def is_finite(estimate: PoseEstimate) -> bool:
    """Whether a pose and its covariance are numbers."""
    return bool(np.isfinite(estimate.pose).all() and np.isfinite(estimate.covariance).all())


def is_headed(found: FilterState | PoseEstimate) -> bool:
    """Whether the heading is known as well as a camera tells it that does not turn."""
    return bool(found.covariance[HEADING, HEADING] <= _TURNING_RAD**2)


def checked_start(
    start: PoseEstimate, odometry_ns: tuple[int, int] | None, now_ns: int | None
) -> PoseEstimate:
    """
    Return a start pose of a time between the first and last odometry, or else of now.

    Raises
    ------
    LandmarkNavError
        A pose or covariance that is not finite, or a covariance that is not positive.

    """
    if not is_finite(start):
        raise LandmarkNavError('start pose: x, y, heading or covariance is not a number')
    if np.linalg.eigvalsh(start.covariance)[0] < -1e-9:
        raise LandmarkNavError('start pose: its covariance is not positive semidefinite')
    if odometry_ns is None:
        return start
    now_ns = max(odometry_ns[1], now_ns or 0)
    if odometry_ns[0] <= start.stamp_ns <= max(now_ns, odometry_ns[1] + 10**9):
        return start
    return replace(start, stamp_ns=now_ns)


def with_joints_in_doubt(
    state: FilterState, found: PoseEstimate, led: FilterState | None
) -> FilterState:
    """
    Doubt the joints of a robot that the camera found, if it turned and nothing else says so.

    Joints that may be late leave much of the heading open. If they were measured, or if what they
    told until now leads to the same heading to a part of that, they are not.
    """
    if is_headed(found) or (state.late.sigma_s > 0.0 and state.late.is_known):
        return state
    if led is not None:
        away = wrap_rad(found.pose[HEADING] - led.mean[HEADING])
        variances = led.covariance[HEADING, HEADING], found.covariance[HEADING, HEADING]
        if away**2 + variances[0] < _LED_SHARE**2 * variances[1]:
            return state
    return with_late_joints(state, LATE_S)


def turned_since(found: FilterState, led: FilterState | None, most_rad: float) -> float:
    """
    Angle by which all bearings are off from where odometry led, in a pose found anew; radians.

    Parameters
    ----------
    found, led : FilterState
        Of one time: as landmarks tell it, and as odometry alone leads to it from where the pose
        was believed last, if it ever was.
    most_rad : float
        How far a camera that was knocked is doubted at most.

    Returns
    -------
    float
        0 where both agree, or the robot was carried or turned elsewhere: that tells nothing of
        the camera.

    """
    if led is None:
        return 0.0
    away = led.mean[:3] - found.mean[:3]
    angle = float(wrap_rad(away[HEADING]))
    spread = found.covariance[:3, :3] + led.covariance[:3, :3]
    near = away[:2] @ np.linalg.solve(spread[:2, :2] + _NEAR_M**2 * np.eye(2), away[:2])
    least = _SURPRISE * np.sqrt(spread[HEADING, HEADING])
    told = near < _SURPRISE**2 and least < abs(angle) < _CARRIED * most_rad
    return angle if told else 0.0


def doubted_turn(
    found: FilterState, turn_rad: float, lever: FloatArray, most_rad: float
) -> FilterState:
    """
    Lay part of an angle of all bearings to the camera, not the base, and doubt both as one.

    What landmarks tell fits any of it: where the pan axis is, and how the camera is directed.

    Parameters
    ----------
    turn_rad : float
        By which all bearings are off, as `turned_since` tells it.
    lever : ndarray, shape (2,)
        Pan axis in the base frame, metres.
    most_rad : float
        How far to doubt at most.

    """
    forward, left = lever
    cosine, sine = np.cos(found.mean[HEADING]), np.sin(found.mean[HEADING])
    by_turn = np.zeros(STATES)
    by_turn[:2] = cosine * left + sine * forward, sine * left - cosine * forward
    by_turn[[HEADING, BORESIGHT]] = 1.0
    camera_share = KNOCKED**2 / (1.0 + KNOCKED**2)
    mean = found.mean + camera_share * turn_rad * by_turn
    mean[HEADING] = wrap_rad(mean[HEADING])
    variance = camera_share * min(abs(turn_rad), most_rad) ** 2
    covariance = found.covariance + variance * np.outer(by_turn, by_turn)
    return replace(found, mean=mean, covariance=covariance)
