"""A room as a person with a tape measures it: what a robot is given is never exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Paper, Room
from landmark_nav.types import FloatArray

__all__ = ['as_measured', 'moved_paper']


# Standard deviations, metres: of a tape through a room, of a ruler along a wall, of the height of
# a camera above the floor.
_WALL_M = 0.005
_PAPER_M = 0.001
_HEIGHT_M = 0.005

_SAME_CORNER_M = 1e-6
_PARALLEL = 0.1


def as_measured(
    room: Room, mount: PanTiltMount, rng: np.random.Generator
) -> tuple[Room, PanTiltMount]:
    """
    Room and mount as a person would write them down.

    Returns
    -------
    room : Room
        Each wall moved along its normal by some millimetres, still meeting its neighbours; papers
        along their walls and up by one.
    mount : PanTiltMount
        Higher or lower by some millimetres.

    """
    off = rng.normal(0.0, _WALL_M, len(room.walls))
    ends = np.array([[wall.start, wall.end] for wall in room.walls])
    moved = [
        [_corner(ends, room.normals[:, :2], off, k, side) for side in (0, 1)]
        for k in range(len(off))
    ]
    walls = tuple(
        replace(wall, start=start, end=end)
        for wall, (start, end) in zip(room.walls, moved, strict=True)
    )
    papers = tuple(moved_paper(p, room, rng.normal(0.0, _PAPER_M, 2)) for p in room.papers)
    x, y, z = mount.axis_xyz
    higher = replace(mount, axis_xyz=(x, y, z + float(rng.normal(0.0, _HEIGHT_M))))
    return replace(room, walls=walls, papers=papers), higher


def moved_paper(paper: Paper, room: Room, shift_m: FloatArray) -> Paper:
    """Paper that hangs elsewhere on its wall: so far along it and up, (2,)."""
    wall = room.walls[int(room.nearest_wall(np.array(paper.center[:2])))]
    x, y = paper.center[:2] + shift_m[0] * np.subtract(wall.end, wall.start) / wall.length
    return replace(paper, center=(float(x), float(y), paper.center[2] + float(shift_m[1])))


def _corner(
    ends: FloatArray, normals: FloatArray, off_m: FloatArray, k: int, side: int
) -> tuple[float, float]:
    """Start or end of wall `k` once all walls are `off_m` (n,): where it meets its neighbour."""
    at = ends[k, side]
    shift = off_m[k] * normals[k]
    for j in range(len(ends)):
        both = np.stack([normals[k], normals[j]])
        meets = np.abs(ends[j, 1 - side] - at).max() < _SAME_CORNER_M
        if meets and abs(np.linalg.det(both)) > _PARALLEL:
            shift = np.linalg.solve(both, np.array([off_m[k], off_m[j]]))
    x, y = (at + shift).tolist()
    return x, y
