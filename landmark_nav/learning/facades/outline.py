"""
The room that facades enclose.

Each direction from the sweeps shows one facade, or the extension of its plane: the likeliest
sequence around them is the outline. Neighbours meet at the intersection of their planes; otherwise
a wall without landmarks joins them.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.se2 import cross, crossing
from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.learning.facades.planes import (
    bare,
    Facade,
    FLOOR_M,
    on_and_through,
    SeenPoints,
)
from landmark_nav.types import FloatArray

_RAYS = 1440
# Least height of walls, m: their tops are not observed; sigma of a facade before adjustment, m.
_HEIGHT_M, FACADE_SIGMA_M = 2.5, 0.03
# A room without facades: number of its walls, their least distance beyond the viewpoints, its
# distance beyond its points, and the share of points inside it.
_OPEN_WALLS, _OPEN_M, _BEYOND_M, _OPEN_SHARE = 12, 1.0, 0.1, 0.98
# Negative log-likelihoods: of a metre of wall without points, of one hidden by another facade, of
# a metre of unknown wall, of a step from one facade to another, and of a cell of points behind.
_BARE, _HIDDEN, _UNKNOWN, _STEP, _BEHIND = 1.0, 0.3, 2.0, 2.5, 1.0
# Greatest depth of furniture, m; size of a cell, m.
_FURNITURE_M, _CELL_M = 0.8, 0.1
# Facades of a smaller difference in distance meet, m; a larger one is a whole step.
_MEET_M = 0.3
# Least sine of the angle between two walls that meet, and between a wall and a ray.
_LEAST_SINE, _LEAST_FACING = 0.2, 0.02
# Shorter walls are left out.
_SHORTEST_M = 0.03
# A wider sector without facades is closed by an arc around the sweeps.
_WIDE_RAD = 2.0
# A facade that is less high above the viewpoint hides little; facades end this far above their
# highest point.
_OVER_EYE_M, _ABOVE_M = 0.2, 0.3
# More than the cost of any outline.
_NEVER = 1e9


def room_of(facades: Sequence[Facade], points: SeenPoints, eyes: FloatArray) -> Room:
    """
    Build a room from facades.

    `points` are those that panoramas share, `eyes` (v, 3) the viewpoints of the sweeps in map.

    Raises `LandmarkNavError`: the facades and the walls that join them do not surround the sweeps.
    """
    tall = [f for f in facades if f.high_m > eyes[:, 2].max() + _OVER_EYE_M]
    height = max([_HEIGHT_M, *(f.high_m + _ABOVE_M for f in facades)])
    corners = []
    if len(tall) > 1:
        corners = _corners(tall, *_outline(tall, points, eyes), eyes[:, :2].mean(0))
    room = _closed(corners, height)
    if not room.contains(eyes[:, :2]).all():
        raise LandmarkNavError(
            f'the {len(tall)} flat surfaces found do not surround the sweeps: take another sweep '
            'that sees more textured walls, or give room.yaml'
        )
    return room


def open_room(points: SeenPoints, eyes: FloatArray) -> Room:
    """Room around all points, if facades enclose none; arguments are those of `room_of`."""
    middle = eyes[:, :2].mean(0)
    reach = np.hypot(*(points.positions[:, :2] - middle).T)
    least = float(np.hypot(*(eyes[:, :2] - middle).T).max()) + _OPEN_M
    far = max(least, float(np.quantile(reach, _OPEN_SHARE)) if len(reach) else 0.0)
    far = far / np.cos(np.pi / _OPEN_WALLS) + _BEYOND_M
    ends = 2.0 * np.pi * np.arange(_OPEN_WALLS) / _OPEN_WALLS
    corners = [(middle + far * np.array([np.cos(a), np.sin(a)]), -1) for a in ends]
    return _closed(corners, _HEIGHT_M)


def _closed(corners: Sequence[tuple[FloatArray, int]], height: float) -> Room:
    """Room of corners; `LandmarkNavError` if there are too few or its walls cross."""
    if len(corners) >= 3:
        walls = []
        for k, (start, facade) in enumerate(corners):
            name, sigma = f'facade{facade + 1}', FACADE_SIGMA_M
            if facade < 0:
                name, sigma = 'gap', 3.0 * FACADE_SIGMA_M
            end, _ = corners[(k + 1) % len(corners)]
            first, last = ((float(p[0]), float(p[1])) for p in (start, end))
            walls.append(Wall(f'{name}_{k + 1}', first, last, height, sigma))
        with suppress(LandmarkNavError):
            return Room(tuple(walls))
    raise LandmarkNavError(
        'the flat surfaces that were found make no room: take sweeps that see more textured '
        'walls, or give room.yaml'
    )


def _outline(
    facades: Sequence[Facade], points: SeenPoints, eyes: FloatArray
) -> tuple[IndexArray, FloatArray]:
    """Likeliest facade along each ray from the middle, -1 for none; distances (k + 1, rays)."""
    # Viterbi's algorithm along the rays (as Flint, Murray and Reid, ICCV 2011): facades extend as
    # planes at a cost; points that are seen through them contradict them.
    middle, step = eyes[:, :2].mean(0), 2.0 * np.pi / _RAYS
    azimuth = step * np.arange(_RAYS)
    ray = np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
    points = points.chosen(points.positions[:, 2] > FLOOR_M)
    # One point of each cell.
    cells = np.floor(points.positions / _CELL_M)
    points = points.chosen(np.unique(cells, axis=0, return_index=True)[1])
    far = np.hypot(*(points.positions[:, :2] - middle).T)
    reach = np.full((len(facades) + 1, _RAYS), _NEVER)
    facing = np.ones_like(reach)
    cost = np.full_like(reach, _UNKNOWN * step * np.median(far))
    empty = np.zeros(reach.shape, dtype=bool)
    for k, facade in enumerate(facades):
        facing[k] = np.maximum(-(ray @ facade.normal), _LEAST_FACING)
        reach[k] = ((middle - facade.start) @ facade.normal) / facing[k]
        along = (middle + reach[k, :, None] * ray - facade.start) @ facade.along
        on, through, crossed = on_and_through(points, facade)
        empty[k] = bare(along, on)
        cost[k] = np.where((facing[k] > _LEAST_FACING) & (reach[k] > 0.0), 0.0, _NEVER)
        # Where points support it, others behind it are outliers, or are reflected.
        at = crossed[through & bare(crossed, on)]
        hit = _ray_of(facade.start + at[:, None] * facade.along - middle)
        np.add.at(cost[k], hit, _BEHIND)
    seen = _ray_of(eyes[:, :2] - middle)
    cost[:, seen] += _NEVER * (reach[:, seen] < np.hypot(*(eyes[:, :2] - middle).T))
    # What is far behind the nearest facade that was observed is hidden by more than furniture.
    observed = np.where(empty | (cost >= _NEVER), _NEVER, reach)[:-1]
    front = observed.argmin(0)
    behind = (reach - observed.min(0)) * facing[front, np.arange(_RAYS)]
    rate = np.select([behind <= 0.0, behind < _FURNITURE_M], [_BARE, _HIDDEN], _UNKNOWN)
    cost[:-1] += (empty * step * reach / facing * rate)[:-1]
    # Two turns, as the first and the last ray are neighbours.
    total, back = cost[:, 0], [np.arange(len(cost))]
    for r in range(1, 2 * _RAYS):
        there = reach[:, r % _RAYS]
        change = _STEP * np.minimum(np.abs(there[:, None] - there) / _MEET_M, 1.0)
        change[-1, :-1] = change[:-1, -1] = 0.5 * _STEP
        tried = total[:, None] + change
        back.append(tried.argmin(0))
        total = tried.min(0) + cost[:, r % _RAYS]
    which = [int(total.argmin())]
    for origin in back[:0:-1]:
        which.append(int(origin[which[-1]]))
    turn = np.roll(which[::-1][_RAYS // 2 : _RAYS // 2 + _RAYS], _RAYS // 2)
    return np.where(turn == len(facades), -1, turn), reach


def _ray_of(off: FloatArray) -> IndexArray:
    """Rays (n,) in the directions (n, 2)."""
    return np.rint(np.arctan2(off[:, 1], off[:, 0]) * _RAYS / (2.0 * np.pi)).astype(int) % _RAYS


def _corners(
    facades: Sequence[Facade], which: IndexArray, reach: FloatArray, middle: FloatArray
) -> list[tuple[FloatArray, int]]:
    """Corners of the outline, each with the facade that starts there; -1 for a joining wall."""

    def point(k: int, r: int) -> FloatArray:
        azimuth = 2.0 * np.pi * r / _RAYS
        ray = np.array([np.cos(azimuth), np.sin(azimuth)])
        return np.asarray(middle + reach[k, r % _RAYS] * ray)

    steps = np.flatnonzero(which != np.roll(which, 1)).tolist()
    corners: list[tuple[FloatArray, int]] = []
    for r, following in zip(steps, [*steps[1:], *steps[:1]], strict=True):
        before, after = int(which[r - 1]), int(which[r])
        end, start = point(before, r - 1), point(after, r)
        if after < 0:
            around = _around(end, point(int(which[following]), following), middle)
            corners += [(end, -1), *[(p, -1) for p in around]]
            continue
        if before >= 0:
            one, other = facades[before], facades[after]
            if abs(cross(one.along, other.along)) > _LEAST_SINE:
                corner = crossing(one.start, one.along, other.start, other.along)
                start = corner if np.hypot(*(corner - start)) < _MEET_M else start
            if np.hypot(*(end - start)) > _MEET_M:
                corners.append((end, -1))
        corners.append((start, after))
    return _without_short(corners)


def _without_short(corners: list[tuple[FloatArray, int]]) -> list[tuple[FloatArray, int]]:
    kept: list[tuple[FloatArray, int]] = []
    for point, facade in corners:
        if kept and np.hypot(*(point - kept[-1][0])) < _SHORTEST_M:
            kept[-1] = (kept[-1][0], facade)
        else:
            kept.append((point, facade))
    if len(kept) > 1 and np.hypot(*(kept[-1][0] - kept[0][0])) < _SHORTEST_M:
        kept.pop()
    return kept


def _around(end: FloatArray, start: FloatArray, middle: FloatArray) -> list[FloatArray]:
    """Points of an arc from `end` to `start`, counter-clockwise, if the sector is wide."""
    first, last = end - middle, start - middle
    azimuth = np.arctan2(first[1], first[0])
    turn = (np.arctan2(last[1], last[0]) - azimuth) % (2.0 * np.pi)
    if turn < _WIDE_RAD:
        return []
    angles = azimuth + np.linspace(0.0, turn, 2 + int(turn / _WIDE_RAD * 2.0))[1:-1]
    reach = max(float(np.hypot(*first)), float(np.hypot(*last)))
    return list(middle + reach * np.stack([np.cos(angles), np.sin(angles)], 1))
