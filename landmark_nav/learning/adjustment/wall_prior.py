"""Walls that are uncertain, moved to where patches show them: the room is their prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from landmark_nav.arrays import BoolArray
from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.learning.adjustment.config import AdjustmentConfig
from landmark_nav.learning.adjustment.solution import Adjustment
from landmark_nav.learning.least_squares import covariance_of
from landmark_nav.types import FloatArray

__all__ = ['moved_walls']

_STEPS = 10
# Misses, in standard deviations, beyond which a patch counts next to nothing.
_TAIL_WIDTH = 2.0
# Neighbours whose planes turn by less do not determine their corner, radians.
_LEAST_CORNER_RAD = 0.2


def moved_walls(
    free: Adjustment, walls: Sequence[int], room: Room, config: AdjustmentConfig
) -> Room:
    """
    Move walls that have a `sigma_m` to the patches on them.

    Parameters
    ----------
    free : Adjustment
        Patches placed by stereo alone.
    walls : sequence of int
        The wall each was looked for on.
    room : Room
        The walls; each end of one is off by its `sigma_m`.
    config : AdjustmentConfig
        How things hang on walls.

    Returns
    -------
    Room
        The same room if no wall moves farther than things hang off walls anyway.

    """
    index = np.asarray(walls, dtype=np.intp)
    fitted = [_fitted(wall, free, index == k, config) for k, wall in enumerate(room.walls)]
    moves = np.array([off for off, _ in fitted])
    if np.abs(moves).max() < config.hanging_sigma_m:
        return room
    starts, ends = (
        np.array([getattr(w, end) for w in room.walls]) + moves[:, k, None] * room.normals[:, :2]
        for k, end in enumerate(('start', 'end'))
    )
    corner = np.empty_like(starts)
    after = [_next(room, k) for k in range(len(room.walls))]
    for k, following in enumerate(after):
        corner[k] = _crossing(starts[k], ends[k], starts[following], ends[following])
    before = np.argsort(after)
    return replace(
        room,
        walls=tuple(
            replace(
                wall,
                start=(float(corner[before[k], 0]), float(corner[before[k], 1])),
                end=(float(corner[k, 0]), float(corner[k, 1])),
                sigma_m=wall.sigma_m and sigma,
            )
            for k, (wall, (_, sigma)) in enumerate(zip(room.walls, fitted, strict=True))
        ),
    )


def _fitted(
    wall: Wall, free: Adjustment, on: BoolArray, config: AdjustmentConfig
) -> tuple[FloatArray, float]:
    """How far both ends of a wall move along its normal (2,), and their sigma then."""
    if not wall.sigma_m:
        return np.zeros(2), 0.0
    normal = wall.normal[:2]
    off = free.positions[on, :2] - wall.start
    share = off @ wall.along / wall.length
    design = np.stack([1.0 - share, share], 1)
    variance = np.einsum('i,nij,j->n', normal, free.own_covariance[on, :2, :2], normal)
    variance += config.relief_sigma_m**2 + config.hanging_sigma_m**2
    prior = np.eye(2) / wall.sigma_m**2
    ends, information, tail = np.zeros(2), prior, variance + wall.sigma_m**2
    for _ in range(_STEPS):
        miss = off @ normal - design @ ends
        # False matches and what stands before the wall do not move it (Geman and McClure).
        weight = (1.0 + miss**2 / (_TAIL_WIDTH**2 * tail)) ** -2.0 / variance
        information = prior + (design * weight[:, None]).T @ design
        ends = np.linalg.solve(information, design.T @ (weight * (off @ normal)))
        tail = np.maximum(variance, 0.5 * tail)
    # Patches that hang together share how they hang.
    own = np.sqrt(np.diag(covariance_of(information)).max())
    return ends, float(np.hypot(own, config.common_hanging_sigma_m))


def _next(room: Room, k: int) -> int:
    """The wall that starts where wall k ends."""
    starts = np.array([wall.start for wall in room.walls])
    return int(np.argmin(np.hypot(*(starts - np.asarray(room.walls[k].end)).T)))


def _crossing(
    start: FloatArray, end: FloatArray, other: FloatArray, other_end: FloatArray
) -> FloatArray:
    """Corner (2,) of a wall and the one after it."""
    along, after = end - start, other_end - other
    sine = along[0] * after[1] - along[1] * after[0]
    if abs(sine) < _LEAST_CORNER_RAD * np.hypot(*along) * np.hypot(*after):
        return np.asarray(0.5 * (end + other))
    off = other - start
    return np.asarray(start + (off[0] * after[1] - off[1] * after[0]) / sine * along)
