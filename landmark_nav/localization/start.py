"""Start poses: checks, and default sigmas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.types import FloatArray, PoseEstimate

# Sigmas of x, y, heading of an unknown pose. Larger ones would lose digits in updates.
_UNKNOWN = np.array([100.0, 100.0, np.pi])


def with_sigmas(start: PoseEstimate, sigma_m: float, sigma_rad: float) -> PoseEstimate:
    """Return a start in which variances of zero are replaced by those of these sigmas."""
    variance = np.square([sigma_m, sigma_m, sigma_rad])
    missing = np.where(start.covariance.diagonal() == 0.0, variance, 0.0)
    return replace(start, covariance=start.covariance + np.diag(missing))


def checked_start(
    start: PoseEstimate, odometry_ns: tuple[int, int] | None = None, now_ns: int | None = None
) -> PoseEstimate:
    """
    Return a valid start pose; its stamp is replaced by now if no odometry is near it.

    Sigmas are limited to those of an unknown pose, 100 m and half a turn.

    Raises `LandmarkNavError`: the pose or covariance is not finite, or the covariance is not
    positive semidefinite.

    Parameters
    ----------
    odometry_ns : tuple of int, optional
        First and last stamp of the odometry.
    now_ns : int, optional
        Present time; the stamp of the last odometry counts if it is later.
    """
    if not (np.isfinite(start.pose).all() and np.isfinite(start.covariance).all()):
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


# With larger sigmas of position (root of the trace) or heading, the appearance of landmarks is not
# predictable, and bearings are not linear.
_WIDE_M, _WIDE_RAD = 0.1, 0.05


def is_prior_uncertain(covariance: FloatArray) -> bool:
    """Whether a covariance (3, 3) of x, y, heading, m and rad, is too wide to predict a view."""
    x, y, heading = covariance.diagonal().tolist()
    return not (x + y <= _WIDE_M**2 and heading <= _WIDE_RAD**2)
