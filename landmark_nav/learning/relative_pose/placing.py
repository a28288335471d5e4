"""First poses of all sweeps, by the relative poses of pairs of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import cross, rotation
from landmark_nav.learning.relative_pose.epipolar import STATE
from landmark_nav.learning.relative_pose.pairs import Pair
from landmark_nav.learning.relative_pose.sheet_tracks import Length
from landmark_nav.learning.relative_pose.two_views import TwoViews
from landmark_nav.types import FloatArray

# Least sine of the angle at which two ways to a sweep determine its place, and do so better than
# a length that has been confirmed.
_LEAST_SINE, _STEEP_SINE = 0.03, 0.3


def placed(
    count: int,
    found: Mapping[Pair, TwoViews],
    ambiguous: Mapping[Pair, Sequence[TwoViews]],
    alone: Sequence[Pair],
    lengths: Mapping[Pair, Length],
    first: FloatArray,
) -> FloatArray:
    """
    States (v, 6), one after the other by the pairs with most support.

    They are where ways from two others cross, or as far away as one of the baselines `lengths`.
    `alone` are pairs without a baseline.
    """
    states = np.zeros((count, STATE))
    done = {max(lengths, key=lambda e: (lengths[e].lead, found[e].support))[0] if lengths else 0}
    while len(done) < count:
        ways = {
            (i, j): _Way.of(states, found[i, j], i, j, i in done)
            for i, j in found
            if (i in done) != (j in done)
        }
        if not ways:
            raise LandmarkNavError(_why_alone(count, done, ambiguous, alone))
        usable = {}
        for e, way in ways.items():
            others = [other for other in ways.values() if other.new == way.new]
            length, lead = lengths.get(e, (0.0, 0.0))
            sine = _STEEP_SINE if length and lead else _LEAST_SINE
            if length := way.crossed(states, others, sine) or length:
                usable[e] = length
        if not usable:
            if still := next((e for e in ways if e in lengths), None):
                raise LandmarkNavError(
                    f'odom shows no motion between sweeps {still[0] + 1} and {still[1] + 1}, '
                    'which the panoramas do: record it while the robot drives'
                )
            lacks = min(way.new for way in ways.values())
            raise LandmarkNavError(
                f'nothing gives the scale: sweep {lacks + 1} shows no sheet of the size given '
                'that another sweep shows, too: hang sheets that both see, or record odom'
            )
        e = max(usable, key=lambda e: found[e].support)
        way, pose, length = ways[e], found[e], usable[e]
        states[way.new, :2] = states[way.near, :2] + length * way.along
        states[way.new, 2] = way.heading_rad
        rise = length * pose.slope
        states[way.new, 3] = states[way.near, 3] + (rise if way.forward else -rise)
        back = rotation(states[way.near, 2] - way.heading_rad)
        tilt = pose.tilt_rad if way.forward else -back @ pose.tilt_rad
        states[way.new, 4:] = back @ states[way.near, 4:] + tilt
        done.add(way.new)
    turn = first[2] - states[0, 2]
    states[:, 4:] -= rotation(states[0, 2] - states[:, 2]) @ states[0, 4:]
    states[:, :2] = first[:2] + (states[:, :2] - states[0, :2]) @ rotation(turn).T
    states[:, 2] = wrap_rad(states[:, 2] + turn)
    states[:, 3] += first[3] - states[0, 3]
    return states


class _Way(NamedTuple):
    """Way from a placed view to a new one, by their relative pose or its inverse."""

    near: int
    new: int
    forward: bool
    heading_rad: float
    along: FloatArray

    @classmethod
    def of(cls, states: FloatArray, pose: TwoViews, i: int, j: int, forward: bool) -> _Way:
        near, new = (i, j) if forward else (j, i)
        here = states[near, 2]
        heading = here + (pose.heading_rad if forward else -pose.heading_rad)
        course = pose.direction_rad + (here if forward else heading + np.pi)
        return cls(near, new, forward, heading, np.array([np.cos(course), np.sin(course)]))

    def crossed(self, states: FloatArray, others: Sequence[_Way], least_sine: float) -> float:
        """Length at which the way that meets this at the largest angle does so; 0 if none does."""
        best, length = least_sine, 0.0
        for other in others:
            sine = float(cross(self.along, other.along))
            gap = states[other.near, :2] - states[self.near, :2]
            if abs(sine) > best and cross(gap, self.along) / sine > 0.0:
                reach = float(cross(gap, other.along)) / sine
                best, length = (abs(sine), reach) if reach > 0.0 else (best, length)
        return length


def _why_alone(
    count: int,
    done: Set[int],
    ambiguous: Mapping[Pair, Sequence[TwoViews]],
    alone: Sequence[Pair],
) -> str:
    """Say what keeps a sweep from being placed."""
    for i, j in alone:
        if (i in done) != (j in done):
            return (
                f'the panoramas of sweeps {i + 1} and {j + 1} are from one place: take another '
                'sweep 1 to 3 m away'
            )
    for (i, j), (best, second, *_) in ambiguous.items():
        if (i in done) != (j in done):
            ways = ' or '.join(
                f'{np.degrees(p.heading_rad):.0f} deg (way at {np.degrees(p.direction_rad):.0f})'
                for p in (best, second)
            )
            return (
                f'sweeps {i + 1} and {j + 1} may be turned by {ways}: {best.support} and '
                f'{second.support} matches agree; take a sweep between them that sees more sides '
                'of the room'
            )
    lacks = next(k for k in range(count) if k not in done)
    return (
        f'the panorama of sweep {lacks + 1} shares too little with the others: take '
        'sweeps 1 to 2 m apart that see the same textured walls'
    )
