"""The room as finitely many points: free floor and samples of the walls."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.walls import Room
from landmark_nav.types import FloatArray

__all__ = ['WallSamples', 'free_floor', 'is_free', 'sample_walls']


class WallSamples(NamedTuple):
    """Points `xy` (s, 2), number and normal (s, 2) of their walls, heights, lengths (s,)."""

    xy: FloatArray
    normal: FloatArray
    wall: npt.NDArray[np.intp]
    wall_height_m: FloatArray
    length_m: FloatArray


def free_floor(room: Room, clearance_m: float, spacing_m: float, most: int) -> FloatArray:
    """
    Places for the robot.

    Parameters
    ----------
    clearance_m : float
        Least distance from them.
    spacing_m : float
        Grid; wider in rooms where that gives more than `most` points.
    most : int
        How many points there may be.

    Returns
    -------
    ndarray, shape (n, 2)
        Row by row; empty in a room that is too narrow.

    """
    low, high = room.bounds[0] + clearance_m, room.bounds[1] - clearance_m
    if np.any(high < low):
        return np.zeros((0, 2))
    spacing = max(spacing_m, float(np.sqrt(np.prod(high - low) / most)))
    # The ends belong to the grid: walls on all sides are looked at alike.
    steps = np.floor((high - low) / spacing + 1e-9).astype(int) + 1
    x, y = (
        np.linspace(a, b, n) if n > 1 else np.array([0.5 * (a + b)])
        for a, b, n in zip(low, high, steps, strict=True)
    )
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return grid[is_free(room, clearance_m, grid)]


def is_free(room: Room, clearance_m: float, xy: FloatArray) -> npt.NDArray[np.bool_]:
    """Whether points (n, 2) lie inside, and `clearance_m` off the walls."""
    clear = room.wall_distances(xy).min(axis=1) >= clearance_m - 1e-9
    return np.asarray(room.contains(xy) & clear)


def sample_walls(room: Room, spacing_m: float, most: int) -> WallSamples:
    """Middles of equal pieces of each wall, about `spacing_m` long, about `most` in all."""
    spacing = max(spacing_m, sum(wall.length for wall in room.walls) / most)
    parts = []
    for k, (wall, normal) in enumerate(zip(room.walls, room.normals, strict=True)):
        count = max(1, round(wall.length / spacing))
        share = (np.arange(count) + 0.5)[:, None] / count
        xy = np.array(wall.start) + share * np.subtract(wall.end, wall.start)
        constant = np.tile([*normal[:2], k, wall.height, wall.length / count], (count, 1))
        parts.append(np.column_stack([xy, constant]))
    table = np.concatenate(parts)
    return WallSamples(
        table[:, :2], table[:, 2:4], table[:, 4].astype(np.intp), table[:, 5], table[:, 6]
    )
