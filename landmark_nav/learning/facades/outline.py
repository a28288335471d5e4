"""
The room that facades enclose.

Seen from the sweeps, the farthest facade in each direction belongs to the outline. Neighbours meet
at the intersection of their planes; otherwise a wall without landmarks joins them.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.se2 import cross, crossing
from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.learning.facades.planes import Facade, FacadesConfig, SeenPoints
from landmark_nav.types import FloatArray

_RAYS = 1440
# A room without facades: number of its walls, their least distance beyond the viewpoints, and the
# share of points inside it.
_OPEN_WALLS, _OPEN_M, _OPEN_SHARE = 12, 1.0, 0.98
# A facade extends beyond its last point by this; a corner is at most this far from the observed
# parts of its two walls.
_BEYOND_M, _FARTHEST_CORNER_M = 0.1, 3.0
# Least sine of the angle between two walls that meet.
_LEAST_SINE = 0.2
# Shorter walls are left out.
_SHORTEST_M = 0.03
# A wider sector without facades is closed by an arc around the sweeps.
_WIDE_RAD = 2.0
# A facade that is less high above the viewpoint hides little; facades end this far above their
# highest point.
_OVER_EYE_M, _ABOVE_M = 0.2, 0.3


def room_of(facades: Sequence[Facade], eyes: FloatArray, config: FacadesConfig) -> Room:
    """
    Build a room from facades.

    Raises `LandmarkNavError`: the facades and the walls that join them do not surround the sweeps.

    Parameters
    ----------
    facades : sequence of Facade
        Facades found.
    eyes : ndarray, shape (v, 3)
        Viewpoints of the sweeps, in map.
    config : FacadesConfig
        Height and sigma of walls.
    """
    tall = [f for f in facades if f.high_m > eyes[:, 2].max() + _OVER_EYE_M]
    middle = eyes[:, :2].mean(0)
    which, points = _seen(tall, middle)
    height = max([config.wall_height_m, *(f.high_m + _ABOVE_M for f in facades)])
    corners = _corners(tall, which, middle)
    try:
        room = _closed(corners, height, config)
    except LandmarkNavError:
        # Intersections of uncertain planes may cross; observed parts in their order do not.
        corners = _seen_corners(which, points, middle)
        room = _closed(corners, height, config)
    if not room.contains(eyes[:, :2]).all():
        raise LandmarkNavError(
            f'the {len(tall)} flat surfaces found do not surround the sweeps: take another sweep '
            'that sees more textured walls, or give room.yaml'
        )
    return room


def open_room(points: SeenPoints, eyes: FloatArray, config: FacadesConfig) -> Room:
    """
    Room around all points, if facades enclose none; nothing is known about its walls.

    Arguments are those of `room_of`; `points` are those that panoramas share.
    """
    middle = eyes[:, :2].mean(0)
    reach = np.hypot(*(points.positions[:, :2] - middle).T)
    least = float(np.hypot(*(eyes[:, :2] - middle).T).max()) + _OPEN_M
    far = max(least, float(np.quantile(reach, _OPEN_SHARE)) if len(reach) else 0.0)
    far = far / np.cos(np.pi / _OPEN_WALLS) + _BEYOND_M
    ends = 2.0 * np.pi * np.arange(_OPEN_WALLS) / _OPEN_WALLS
    corners = [(middle + far * np.array([np.cos(a), np.sin(a)]), -1) for a in ends]
    return _closed(corners, config.wall_height_m, config)


def _closed(
    corners: Sequence[tuple[FloatArray, int]], height: float, config: FacadesConfig
) -> Room:
    """Room of corners; `LandmarkNavError` if there are too few or its walls cross."""
    if len(corners) >= 3:
        ends = [point for point, _ in [*corners[1:], corners[0]]]
        walls = tuple(
            _wall(facade, k, start, end, height, config)
            for k, ((start, facade), end) in enumerate(zip(corners, ends, strict=True))
        )
        with suppress(LandmarkNavError):
            return Room(walls)
    raise LandmarkNavError(
        'the flat surfaces that were found make no room: take sweeps that see more textured '
        'walls, or give room.yaml'
    )


def _wall(
    facade: int,
    number: int,
    start: FloatArray,
    end: FloatArray,
    height: float,
    config: FacadesConfig,
) -> Wall:
    name = f'facade{facade + 1}' if facade >= 0 else 'gap'
    first, last = ((float(p[0]), float(p[1])) for p in (start, end))
    sigma = config.sigma_m * (1.0 if facade >= 0 else 3.0)
    return Wall(f'{name}_{number + 1}', first, last, height, sigma)


def _seen(facades: Sequence[Facade], middle: FloatArray) -> tuple[IndexArray, FloatArray]:
    """The farthest facade along rays (n,), counter-clockwise, -1 for none; the point (n, 2)."""
    azimuth = 2.0 * np.pi * np.arange(_RAYS) / _RAYS
    ray = np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
    which, farthest = np.full(_RAYS, -1), np.zeros(_RAYS)
    # Beyond its last point a facade counts only if there is no other.
    for beyond_m in (0.0, _BEYOND_M):
        unseen = which < 0
        for k, facade in enumerate(facades):
            facing = ray @ facade.normal
            with np.errstate(divide='ignore', invalid='ignore'):
                reach = (facade.start - middle) @ facade.normal / facing
                along = (middle + reach[:, None] * ray - facade.start) @ facade.along
            hit = unseen & (facing < 0.0) & (reach > farthest)
            hit &= (along > -beyond_m) & (along < facade.length_m + beyond_m)
            farthest[hit], which[hit] = reach[hit], k
    return which, middle + farthest[:, None] * ray


def _corners(
    facades: Sequence[Facade], which: IndexArray, middle: FloatArray
) -> list[tuple[FloatArray, int]]:
    """Corners of the outline, each with the facade that starts there; -1 for a joining wall."""
    seen = which[which >= 0]
    runs = seen[np.flatnonzero(seen != np.roll(seen, 1))].tolist()
    if len(runs) < 2:
        return []
    corners: list[tuple[FloatArray, int]] = []
    for first, second in zip(runs, [*runs[1:], runs[0]], strict=True):
        one, other = facades[first], facades[second]
        meet = abs(cross(one.along, other.along)) > _LEAST_SINE
        corner = crossing(one.start, one.along, other.start, other.along) if meet else None
        if corner is not None and _fits(corner, one.end, other.start):
            corners.append((corner, second))
        else:
            around = [(point, -1) for point in _around(one.end, other.start, middle)]
            corners += [(one.end, -1), *around, (other.start, second)]
    return _without_short(corners)


def _seen_corners(
    which: IndexArray, points: FloatArray, middle: FloatArray
) -> list[tuple[FloatArray, int]]:
    """Corners as `_corners` gives, where each facade ends at the last ray that hits it."""
    starts = np.flatnonzero(which != np.roll(which, 1))
    runs = [
        (points[begin], points[end - 1], int(which[begin]))
        for begin, end in zip(starts, np.roll(starts, -1), strict=True)
        if which[begin] >= 0
    ]
    if len(runs) < 2:
        return []
    corners: list[tuple[FloatArray, int]] = []
    for k, (start, end, facade) in enumerate(runs):
        corners += [(start, facade), (end, -1)]
        around = _around(end, runs[(k + 1) % len(runs)][0], middle)
        corners += [(point, -1) for point in around]
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


def _fits(corner: FloatArray, end: FloatArray, start: FloatArray) -> bool:
    """Whether a corner is near the observed parts of both walls."""
    return bool(
        np.hypot(*(corner - end)) < _FARTHEST_CORNER_M
        and np.hypot(*(corner - start)) < _FARTHEST_CORNER_M
    )
