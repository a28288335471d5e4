"""What a plan is compared with: random places, and the layout of Livatino and Madsen."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.walls import Room
from landmark_nav.planning.config import PlanConfig
from landmark_nav.planning.room_grid import is_free
from landmark_nav.types import FloatArray

__all__ = ['left_right_layout', 'random_sets']

# Least distance between two random places: nearer ones learning refuses.
_APART_M = 0.5


def left_right_layout(room: Room, count: int, share: float, config: PlanConfig) -> FloatArray:
    """
    Places L and R, or L1, R1, L2, R2 for four and more.

    They lie left and right of the room's middle for someone who faces the wall with the papers,
    or the longest one, a pair before the middle and one behind it if there are two.

    Parameters
    ----------
    room : Room
        Walls, and papers if poses come from them.
    count : int
        How many places are planned.
    share : float
        Distance of L and of R from the middle, as a share of the room's extent.
    config : PlanConfig
        Clearance.

    Returns
    -------
    ndarray, shape (k, 2)
        2 or 4 places; none if one of them is not on the free floor.

    """
    corners = np.array([wall.start for wall in room.walls])
    middle = 0.5 * (room.bounds[0] + room.bounds[1])
    faced = int(np.argmax([wall.length for wall in room.walls]))
    if room.papers:
        papers = np.mean([paper.center[:2] for paper in room.papers], axis=0)
        faced = int(room.nearest_wall(papers))
    ahead = room.normals[faced, :2]
    aside = np.array([-ahead[1], ahead[0]])
    width, depth = (np.ptp(corners @ axis) for axis in (aside, ahead))
    rows = [-share, share] if count >= 4 else [0.0]
    places = np.array(
        [middle + row * depth * ahead + k * width * aside for row in rows for k in (-share, share)]
    )
    free = is_free(room, config.clearance_m, places)
    return places if free.all() else np.zeros((0, 2))


def random_sets(
    xy: FloatArray, count: int, sets: int, rng: np.random.Generator
) -> npt.NDArray[np.intp]:
    """
    Random sets of places.

    Parameters
    ----------
    xy : ndarray, shape (p, 2)
        All places.
    count, sets : int
        How many places a set has, and how many sets.
    rng : numpy.random.Generator
        Draws them.

    Returns
    -------
    ndarray of int, shape (sets, count)
        No two places of a set are the same or, if there are others, next to each other.

    """
    drawn = []
    for _ in range(sets):
        best = rng.choice(len(xy), count, replace=False)
        for _ in range(100):
            gaps = np.linalg.norm(xy[best][:, None] - xy[best], axis=-1)
            if np.all(gaps[np.triu_indices(count, 1)] >= _APART_M):
                break
            best = rng.choice(len(xy), count, replace=False)
        drawn.append(best)
    return np.array(drawn, dtype=np.intp)
