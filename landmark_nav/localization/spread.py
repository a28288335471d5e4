"""Corrections of ``map`` -> ``odom`` spread over time, so that controllers see no jump."""

from __future__ import annotations

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import compose, inverse
from landmark_nav.types import FloatArray

__all__ = ['SpreadCorrection']


class SpreadCorrection:
    """
    The transform ``map`` -> ``odom`` that follows the fused pose with a first-order lag.

    The lag acts on the pose of the base, not on the transform: otherwise a correction of the
    heading would swing the robot about the origin of ``odom``, however far away that is.

    Parameters
    ----------
    time_constant_s : float
        After which 63 % of a correction has been made; 0 makes all of it at once.

    """

    def __init__(self, time_constant_s: float) -> None:
        self._time_constant_s = time_constant_s
        self._last: tuple[int, FloatArray] | None = None

    def restart(self) -> None:
        """Take the next pose as it is: it is not a correction but another place."""
        self._last = None

    def at(
        self, stamp_ns: int, pose_map_base: FloatArray, pose_odom_base: FloatArray
    ) -> FloatArray:
        """
        Transform at a time.

        Parameters
        ----------
        stamp_ns : int
            Of both poses; one before the last stamp restarts.
        pose_map_base, pose_odom_base : ndarray, shape (3,)
            The base as fused, and as its odometry has it.

        Returns
        -------
        ndarray, shape (3,)
            Pose of ``odom`` in ``map``.

        """
        shown = pose_map_base
        if self._last is not None and self._time_constant_s > 0.0 and stamp_ns >= self._last[0]:
            seconds = (stamp_ns - self._last[0]) * 1e-9
            ahead = compose(self._last[1], pose_odom_base)
            remaining = pose_map_base - ahead
            remaining[2] = wrap_rad(remaining[2])
            shown = pose_map_base - np.exp(-seconds / self._time_constant_s) * remaining
        self._last = stamp_ns, compose(shown, inverse(pose_odom_base))
        return self._last[1]
