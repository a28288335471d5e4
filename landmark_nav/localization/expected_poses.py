"""Fused poses at the time of an image, and as the transform ``map`` -> ``odom``."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import compose, inverse
from landmark_nav.localization.odometry.noise import twist_motion
from landmark_nav.types import FloatArray, OdometrySample, PoseEstimate, Refusal

_HISTORY = 200
# A pose is extrapolated over this time: an image need not wait for the next odometry.
_AHEAD_NS = 100_000_000

_Pose = TypeVar('_Pose', bound=PoseEstimate)


class ExpectedPoses(Generic[_Pose]):
    """The last fused poses, for requests up to `max_age_s` from one."""

    def __init__(self, max_age_s: float) -> None:
        self._max_age_ns = round(1e9 * max_age_s)
        self._known: deque[tuple[_Pose, float, float]] = deque(maxlen=_HISTORY)

    def add(self, pose: _Pose, speeds: OdometrySample) -> None:
        """Add a fused pose and the speeds at its time."""
        known = (pose, speeds.linear_m_s, speeds.angular_rad_s)
        if self._known and self._known[-1][0].stamp_ns - pose.stamp_ns > self._max_age_ns:
            # The clock was set back: older poses would lie in the future. The deque is replaced,
            # not cleared, as the thread of the images reads it meanwhile.
            self._known = deque([known], maxlen=_HISTORY)
        else:
            self._known.append(known)

    def recent(self, stamp_ns: int, max_age_s: float | None = None) -> _Pose | None:
        """The last pose; None if it is farther from `stamp_ns` than `max_age_s`, or none came."""
        newest = self._known[-1][0] if self._known else None
        age_ns = self._max_age_ns if max_age_s is None else round(1e9 * max_age_s)
        return newest if newest and abs(stamp_ns - newest.stamp_ns) <= age_ns else None

    def reaches(self, stamp_ns: int) -> bool:
        """Whether the last pose is recent enough to be extrapolated to that time."""
        return bool(self._known) and self._known[-1][0].stamp_ns >= stamp_ns - _AHEAD_NS

    def at(self, stamp_ns: int) -> _Pose | Refusal:
        """Pose at a time: the nearest one, extrapolated by its speeds."""
        known = tuple(self._known)
        if not known:
            return Refusal('no fused pose yet', 'it takes odom, and a start on initialpose')
        # Of poses of one time the last counts: it was corrected by an image.
        pose, linear, angular = min(
            reversed(known), key=lambda entry: abs(entry[0].stamp_ns - stamp_ns)
        )
        seconds = (stamp_ns - pose.stamp_ns) * 1e-9
        if abs(stamp_ns - pose.stamp_ns) > self._max_age_ns:
            return Refusal('no fused pose near its stamp', f'the nearest is {seconds:+.2f} s off')
        moved = compose(pose.pose, twist_motion(linear, angular, seconds))
        return replace(pose, stamp_ns=stamp_ns, pose=moved)


class SpreadCorrection:
    """
    The transform ``map`` -> ``odom``, which follows the fused pose with a first-order lag.

    The lag acts on the pose of the base, not on the transform: otherwise a correction of the
    heading would rotate the robot about the distant origin of ``odom``.

    Parameters
    ----------
    time_constant_s : float
        Time after which 63 % of a correction is applied; 0 applies all at once.
    """

    def __init__(self, time_constant_s: float) -> None:
        self.time_constant_s = time_constant_s
        self._last: tuple[int, FloatArray] | None = None

    def restart(self) -> None:
        """Apply the next pose at once: it is a new place, not a correction."""
        self._last = None

    def at(
        self, stamp_ns: int, pose_map_base: FloatArray, pose_odom_base: FloatArray
    ) -> FloatArray:
        """
        Transform at a time.

        Parameters
        ----------
        stamp_ns : int
            Stamp of both poses; a stamp before the last one restarts.
        pose_map_base, pose_odom_base : ndarray, shape (3,)
            Fused pose, and pose by odometry.

        Returns
        -------
        ndarray, shape (3,)
            Pose of ``odom`` in ``map``.
        """
        shown = pose_map_base
        if self._last is not None and self.time_constant_s > 0.0 and stamp_ns >= self._last[0]:
            seconds = (stamp_ns - self._last[0]) * 1e-9
            ahead = compose(self._last[1], pose_odom_base)
            remaining = pose_map_base - ahead
            remaining[2] = wrap_rad(remaining[2])
            shown = pose_map_base - np.exp(-seconds / self.time_constant_s) * remaining
        self._last = stamp_ns, compose(shown, inverse(pose_odom_base))
        return self._last[1]
