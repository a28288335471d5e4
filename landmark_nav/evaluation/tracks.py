"""Poses over time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IntArray
from landmark_nav.geometry import se2
from landmark_nav.types import FloatArray


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """
    Planar poses at increasing times.

    Parameters
    ----------
    stamps_ns : ndarray of int, shape (n,)
        Strictly increasing.
    poses : ndarray, shape (n, 3)
        x [m], y [m], heading [rad].

    """

    stamps_ns: IntArray
    poses: FloatArray

    @classmethod
    def of(cls, stamped: Iterable[tuple[int, FloatArray]]) -> PoseTrack:
        """Sort stamped poses (3,); of several with one stamp the last counts."""
        by_stamp = dict(stamped)
        stamps = sorted(by_stamp)
        poses = [by_stamp[stamp] for stamp in stamps]
        return cls(np.array(stamps, np.int64), np.array(poses, np.float64).reshape(-1, 3))

    def __len__(self) -> int:
        """Return how many poses there are."""
        return len(self.stamps_ns)

    def seen_from(self, pose: FloatArray, scale: float = 1.0) -> PoseTrack:
        """The track in the frame of a pose (3,), its ways `scale` times as long."""
        poses = se2.relative(pose, self.poses)
        return PoseTrack(self.stamps_ns, poses * [scale, scale, 1.0])

    def carry(self, known: PoseTrack) -> PoseTrack:
        """Carry `known` poses on, each until the next one, as this track moves; NaN beyond it."""
        inside = (self.stamps_ns > known.stamps_ns[0]) & (self.stamps_ns < known.stamps_ns[-1])
        stamps = np.union1d(known.stamps_ns, self.stamps_ns[inside])
        last = np.searchsorted(known.stamps_ns, stamps, 'right') - 1
        moved = se2.relative(self.at(known.stamps_ns[last]), self.at(stamps))
        moved[stamps == known.stamps_ns[last]] = 0.0
        return PoseTrack(stamps, se2.compose(known.poses[last], moved))

    def at(self, stamps_ns: npt.ArrayLike) -> FloatArray:
        """
        Interpolate at constant twist in SE(2).

        Parameters
        ----------
        stamps_ns : array_like of int, shape (m,)
            When.

        Returns
        -------
        ndarray, shape (m, 3)
            NaN before the first and after the last pose.

        """
        stamps = np.atleast_1d(np.asarray(stamps_ns, dtype=np.int64))
        found = np.full((len(stamps), 3), np.nan)
        if not len(self):
            return found
        inside = (stamps >= self.stamps_ns[0]) & (stamps <= self.stamps_ns[-1])
        after = np.clip(np.searchsorted(self.stamps_ns, stamps[inside]), 1, max(1, len(self) - 1))
        if len(self) == 1:
            found[inside] = self.poses[0]
            return found
        before = after - 1
        span = self.stamps_ns[after] - self.stamps_ns[before]
        share = (stamps[inside] - self.stamps_ns[before]) / span
        step = se2.relative(self.poses[before], self.poses[after])
        # Exponential of a share of the logarithm: the chord shrinks and turns with the turn.
        turn = step[:, 2]
        ratio = share * np.sinc(share * turn / (2 * np.pi)) / np.sinc(turn / (2 * np.pi))
        bend = se2.rotation((share - 1.0) * turn / 2.0)
        chord = np.einsum('nij,nj->ni', bend, step[:, :2]) * ratio[:, None]
        part = np.column_stack([chord, share * turn])
        found[inside] = se2.compose(self.poses[before], part)
        return found
