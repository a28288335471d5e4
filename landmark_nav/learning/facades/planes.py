"""
Flat vertical surfaces among matched features: lines in plan.

The line with the most support is taken repeatedly (RANSAC; Fischler and Bolles, 1981). Support is
counted in cells of the surface, so that one richly textured object is not a wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from landmark_nav.arrays import BoolArray, IndexArray
from landmark_nav.geometry.se2 import cross
from landmark_nav.learning.relative_pose.epipolar import (
    center,
    DIRECTION_SIGMA_RAD,
    RayPairs,
    turned,
)
from landmark_nav.learning.right_angles import common_direction, from_right, pull
from landmark_nav.types import FloatArray

# Points with a larger sigma, m, or a smaller parallax, rad, are not used.
_MAX_SIGMA_M, _LEAST_PARALLAX = 0.15, 0.035


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """
    Points (n, 3) in map, their covariance in plan (n, 2, 2), and one viewpoint of each (n, 3).

    The covariance is without errors of the poses, which all points share.
    """

    positions: FloatArray
    covariance: FloatArray
    viewpoints: FloatArray

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.positions)

    @classmethod
    def joined(cls, parts: Sequence[SeenPoints]) -> SeenPoints:
        """Concatenate several sets."""
        every = ((p.positions, p.covariance, p.viewpoints) for p in parts)
        return cls(*map(np.concatenate, zip(*every, strict=True)))

    def chosen(self, which: BoolArray | IndexArray) -> SeenPoints:
        """Return the points selected by `which`, a mask or indices."""
        return SeenPoints(self.positions[which], self.covariance[which], self.viewpoints[which])


def placed_matches(states: FloatArray, pairs: RayPairs) -> tuple[SeenPoints, RayPairs]:
    """
    Intersect the rays of inlier matches in plan; return points and pairs with enough parallax.

    `states` (v, 6) are those of the sweeps from `relative_poses`.
    """
    here, there = (center(states[k]) for k in (pairs.one, pairs.other))
    w = turned(states[pairs.one], pairs.rays)
    v = turned(states[pairs.other], pairs.other_rays)
    w, v = (r / np.hypot(r[:, 0], r[:, 1])[:, None] for r in (w, v))
    way = there - here
    sine = cross(w, v)
    with np.errstate(divide='ignore', invalid='ignore'):
        reach, reach_there = cross(way, v) / sine, cross(way, w) / sine
        first, second = here + reach[:, None] * w, there + reach_there[:, None] * v
        along = (
            (reach_there * DIRECTION_SIGMA_RAD / sine) ** 2,
            (reach * DIRECTION_SIGMA_RAD / sine) ** 2,
        )
    covariance = along[1][:, None, None] * v[:, :2, None] * v[:, None, :2]
    covariance += along[0][:, None, None] * w[:, :2, None] * w[:, None, :2]
    certain = (np.abs(sine) > np.sin(_LEAST_PARALLAX)) & (reach > 0.0) & (reach_there > 0.0)
    certain &= np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1]) < _MAX_SIGMA_M
    points = SeenPoints(0.5 * (first + second), covariance, np.broadcast_to(here, first.shape))
    return points.chosen(certain), pairs.chosen(certain)


# Sigma of points of a facade about its plane, m.
_RELIEF_M = 0.015
# Fewest cells of 10 cm x 10 cm that contain points; half at a right angle to other facades.
_MIN_CELLS = 12
# Least length of a facade and longest part of it without points, m.
_MIN_LENGTH_M, _MAX_GAP_M = 0.4, 1.2
_MOST_FACADES = 24
_TRIALS, _SEED = 600, 5
# Greatest distance of the two points of a trial, m; bound of inliers, in sigmas.
_REACH_M, _INLIER_SIGMAS = 3.0, 2.5
_CELL_M = 0.1
_MOST_ROWS = 1e6
# Points nearer than this to a facade and not on it contradict it, m; those on it support as much
# of it to either side, m.
_BESIDE_M, _SUPPORT_M = 0.15, 0.2
# Least accuracy of the direction of a facade by the groups of its points, rad.
_TURN_RAD, _NOTHING = 0.15, 1e-9
# Prior of a line at no right angle to the others, relative to one that is within this angle, rad.
_OBLIQUE, _RIGHT_RAD = 0.5, 0.02
# Length of a section of a wall, in which all points are equally far from it, m.
SECTION_M = 0.6
# Lower points belong to the floor.
FLOOR_M = 0.08
_REFITS = 4
# Points this near to a facade belong to it and to no other, m.
_TAKEN_M = 0.06
# Least cosine between the normals of parts of one facade.
_SAME_NORMAL = 0.98


@dataclass(frozen=True, eq=False)
class Facade:
    """
    A vertical rectangle from `start` to `end` (2,) in map, with the room on its left.

    It was observed between the heights `low_m` and `high_m`; `cells` of it contain points. Any two
    groups of points lie on a common line: `turn_rad` is the sigma of its direction by the points
    on one side of its widest gap.
    """

    start: FloatArray
    end: FloatArray
    low_m: float
    high_m: float
    cells: int
    turn_rad: float

    @property
    def along(self) -> FloatArray:
        """Unit vector from start to end, (2,)."""
        side = self.end - self.start
        return np.asarray(side / np.hypot(*side))

    @property
    def angle_rad(self) -> float:
        """Direction from start to end, rad."""
        return float(np.arctan2(self.along[1], self.along[0]))

    @property
    def normal(self) -> FloatArray:
        """Unit normal into the room, (2,)."""
        return np.array([-self.along[1], self.along[0]])

    @property
    def length_m(self) -> float:
        """Length, m."""
        return float(np.hypot(*(self.end - self.start)))


def find_facades(points: SeenPoints) -> list[Facade]:
    """Find facades among points, in the order of their support."""
    left = above = points.chosen(points.positions[:, 2] > FLOOR_M)
    rng = np.random.default_rng(_SEED)
    found: list[SeenPoints] = []
    common, fewest = None, _OBLIQUE * _MIN_CELLS
    while len(found) < _MOST_FACADES and len(left) >= fewest:
        members = _best_line(left, rng, common)
        if members is None:
            break
        facade = _fit(left.chosen(members), common)
        if facade.length_m < _MIN_LENGTH_M:
            left = left.chosen(~members)
            continue
        cells = facade.cells - _cells_beside(above, facade)
        likely = _prior(facade.angle_rad, common) * cells >= fewest
        if likely and facade.turn_rad < _TURN_RAD:
            found.append(left.chosen(members))
            common = _common(found)
            # What is seen through a wall is a reflection, or falsely matched.
            on, through, crossed = on_and_through(left, facade)
            members = members | (through & ~bare(crossed, on))
        left = left.chosen(~(members | _covered(left, facade)))
    return sorted(_joined(found, common), key=lambda f: -f.cells)


def _common(found: list[SeenPoints]) -> float:
    """Direction to which most facades are at right angles."""
    _, along, variance = map(np.array, zip(*(_line(m) for m in found), strict=True))
    length = [np.ptp(m.positions[:, :2] @ a) for m, a in zip(found, along, strict=True)]
    return common_direction(np.arctan2(along[:, 1], along[:, 0]), variance, np.array(length))


def _joined(found: list[SeenPoints], common: float | None) -> list[Facade]:
    """Facades, with parts of one facade joined."""
    facades = [_fit(members, common) for members in found]
    bound = _INLIER_SIGMAS * _RELIEF_M
    k = 0
    while k < len(facades):
        for j in range(k + 1, len(facades)):
            if facades[k].normal @ facades[j].normal < _SAME_NORMAL:
                continue
            both = SeenPoints.joined([found[k], found[j]])
            whole = _fit(both, common)
            ends = np.array([(f.start, f.end) for f in (facades[k], facades[j])])
            off = (ends - whole.start) @ whole.normal
            # The front of a cupboard and the wall next to it also fit a line, but a rotated one.
            near = max(np.abs(off).max(), np.abs(np.diff(off)).max()) < bound
            right, was = (_prior(f.angle_rad, common) for f in (whole, facades[k]))
            if near and right >= was:
                found[k], facades[k] = both, whole
                del found[j], facades[j]
                break
        else:
            k += 1
    return facades


def _cells_beside(points: SeenPoints, facade: Facade) -> int:
    """How many cells of a facade hold points that are near it and yet not on it."""
    off = points.positions[:, :2] - facade.start
    along, away = off @ facade.along, np.abs(off @ facade.normal)
    height = points.positions[:, 2]
    beside = (along > 0.0) & (along < facade.length_m) & (away < _BESIDE_M)
    beside &= (height > facade.low_m) & (height < facade.high_m)
    variance = _variance(points, facade.normal)
    beside &= away > _INLIER_SIGMAS * np.sqrt(variance)
    return _cells(along[beside], height[beside])


def on_and_through(points: SeenPoints, facade: Facade) -> tuple[FloatArray, BoolArray, FloatArray]:
    """
    Points on the plane of a facade and seen through it.

    Positions (m,) along it of the points on it, m; which points (n,) are seen through it, below
    its top; where along it (n,) the lines of sight cross it, m.
    """
    off = points.positions[:, :2] - facade.start
    ahead = (points.viewpoints[:, :2] - facade.start) @ facade.normal
    away = off @ facade.normal
    bound = _INLIER_SIGMAS * np.sqrt(_variance(points, facade.normal))
    on = (np.abs(away) < bound) & (ahead > 0.0)
    through = (away < -np.maximum(bound, _BESIDE_M)) & (ahead > 0.0)
    share = np.where(through, ahead, 0.0) / np.where(through, ahead - away, 1.0)
    crossing = points.viewpoints + share[:, None] * (points.positions - points.viewpoints)
    through &= crossing[:, 2] < facade.high_m
    crossed = (crossing[:, :2] - facade.start) @ facade.along
    return off[on] @ facade.along, through, crossed


def bare(along: FloatArray, on: FloatArray) -> BoolArray:
    """Which positions (..., n) along a facade have no points (m,) near them."""
    ends = np.concatenate([[-np.inf], np.sort(on), [np.inf]])
    after = np.searchsorted(ends[:-1], along)
    return np.asarray(np.minimum(along - ends[after - 1], ends[after] - along) > _SUPPORT_M)


def _line(
    members: SeenPoints, common: float | None = None
) -> tuple[FloatArray, FloatArray, float]:
    """Robust line, at a right angle to `common` if likely: middle, direction, its variance."""
    xy, weight = members.positions[:, :2], np.ones(len(members))
    for _ in range(_REFITS):
        middle = np.average(xy, axis=0, weights=weight)
        off = xy - middle
        along = np.linalg.eigh((weight[:, None] * off).T @ off)[1][:, 1]
        turn = 1.0 / float(np.sum(weight * (off @ along) ** 2) + _NOTHING)
        if common is not None:
            angle = np.arctan2(along[1], along[0])
            angle -= turn * float(pull(angle, np.array(turn), common))
            along = np.array([np.cos(angle), np.sin(angle)])
        normal = np.array([-along[1], along[0]])
        miss = off @ normal
        variance = _variance(members, normal)
        # What hangs in one section of a wall is equally far from it.
        section = np.unique(np.floor(off @ along / SECTION_M), return_inverse=True)[1]
        alike = np.bincount(section)[section] * _RELIEF_M**2
        weight = (1.0 + miss**2 / variance / 4.0) ** -2.0 / (variance + alike)
    return middle, along, turn


def _fit(members: SeenPoints, common: float | None) -> Facade:
    """Facade through points, as `_line`."""
    middle, along, _ = _line(members, common)
    xy = members.positions[:, :2]
    normal = np.array([-along[1], along[0]])
    variance, miss = _variance(members, normal), (xy - middle) @ normal
    eye = members.viewpoints[:, :2].mean(0)
    normal = normal if (eye - middle) @ normal > 0.0 else -normal
    along = np.array([normal[1], -normal[0]])
    kept = miss**2 < _INLIER_SIGMAS**2 * variance
    kept = kept if kept.any() else np.ones(len(xy), dtype=bool)
    t = (xy - middle)[kept] @ along
    z = members.positions[kept, 2]
    return Facade(
        middle + t.min() * along,
        middle + t.max() * along,
        float(z.min()),
        float(z.max()),
        _cells(t, z),
        _turn(t, miss[kept], variance[kept]),
    )


def _turn(along: FloatArray, miss: FloatArray, variance: FloatArray) -> float:
    """How far off the direction of a line (n,) points may be, by what its widest gap divides."""
    order = np.argsort(along, kind='stable')
    gaps = np.diff(along[order], prepend=along[order[0]])
    weight = 1.0 / variance
    pull, information = 0.0, _NOTHING
    for group in np.split(order, [int(np.argmax(gaps))]):
        if len(group):
            off = along[group] - np.average(along[group], weights=weight[group])
            pull += float(np.sum(weight[group] * off * miss[group]))
            information += float(np.sum(weight[group] * off**2))
    return float(np.hypot(pull / information, information**-0.5))


def _variance(points: SeenPoints, normal: FloatArray) -> FloatArray:
    (x, y), own = normal, points.covariance
    return np.asarray(
        x**2 * own[:, 0, 0] + 2.0 * x * y * own[:, 0, 1] + y**2 * own[:, 1, 1] + _RELIEF_M**2
    )


def _cells(along: FloatArray, height: FloatArray) -> int:
    """Number of cells of a surface that contain points."""
    column, row = np.floor(along / _CELL_M), np.floor(height / _CELL_M)
    return len(np.unique(column * _MOST_ROWS + row))


def _best_line(
    points: SeenPoints, rng: np.random.Generator, common: float | None
) -> BoolArray | None:
    """Points (n,) on the part of a line with the most support; None if there is too little."""
    xy = points.positions[:, :2]
    best, most = None, 0.0
    for trial, first in enumerate(rng.integers(len(xy), size=_TRIALS)):
        off = xy - xy[first]
        apart = np.hypot(*off.T)
        near = np.flatnonzero((apart > _CELL_M) & (apart < _REACH_M))
        if not len(near):
            continue
        side = off[rng.choice(near)]
        angle = np.arctan2(side[1], side[0])
        if common is not None and trial % 2:  # every other line is turned to a right angle
            angle -= from_right(angle - common)
        along = np.array([np.cos(angle), np.sin(angle)])
        normal = np.array([-along[1], along[0]])
        ahead = (points.viewpoints[:, :2] - xy[first]) @ normal
        miss = (off @ normal) ** 2 / _variance(points, normal)
        on = (miss < _INLIER_SIGMAS**2) & (np.sign(ahead) == np.sign(ahead[first]))
        # No more cells than points.
        prior = _prior(angle, common)
        if prior * np.count_nonzero(on) <= most:
            continue
        on = _stretch(off @ along, on)
        cells = _cells((off @ along)[on], points.positions[on, 2])
        support = prior * cells * float(np.mean(1.0 - miss[on] / _INLIER_SIGMAS**2))
        if support > most:
            best, most = on, support
    return best if most >= 0.4 * _OBLIQUE * _MIN_CELLS else None


def _prior(angle_rad: float, common: float | None) -> float:
    """Likelihood of a line, relative to one at a right angle to the `common` direction."""
    right = common is not None and abs(from_right(np.asarray(angle_rad - common))) < _RIGHT_RAD
    return 1.0 if right else _OBLIQUE


def _stretch(along: FloatArray, on: BoolArray) -> BoolArray:
    """Points of the longest part without a gap, among those on a line."""
    index = np.flatnonzero(on)
    index = index[np.argsort(along[index], kind='stable')]
    breaks = np.flatnonzero(np.diff(along[index]) > _MAX_GAP_M) + 1
    part = max(np.split(index, breaks), key=len)
    kept = np.zeros(len(along), dtype=bool)
    kept[part] = True
    return kept


def _covered(points: SeenPoints, facade: Facade) -> BoolArray:
    """Points (n,) that belong to a facade."""
    off = points.positions[:, :2] - facade.start
    along = off @ facade.along
    inside = (along > -_CELL_M) & (along < facade.length_m + _CELL_M)
    bound = np.maximum(_INLIER_SIGMAS * np.sqrt(_variance(points, facade.normal)), _TAKEN_M)
    return np.asarray(inside & (np.abs(off @ facade.normal) < bound))
