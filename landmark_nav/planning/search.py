"""
The best set of places: best pair, greedy growth, exchange.

Growth starts from a pair because one panorama alone is worth nothing; what greed missed is made
good by exchanging one place at a time (Fedorov, Theory of Optimal Experiments, 1972).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import combinations

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IndexArray
from landmark_nav.geometry.walls import Room
from landmark_nav.planning.config import PlanConfig
from landmark_nav.planning.views import is_free
from landmark_nav.types import FloatArray

# Of a set of places (n,).
Cost = Callable[[IndexArray], float]

# Passes items through and shows how far it is: description, how many.
Show = Callable[[Iterable[IndexArray], str, int], Iterator[IndexArray]]

_MAX_ROUNDS = 12

# A round that gains a smaller share than this is the last one.
_LEAST_GAIN = 0.004


def best_places(
    cost: Cost, xy: FloatArray, count: int, seeds: IndexArray, show: Show
) -> IndexArray:
    """
    Choose places that make a cost small.

    Parameters
    ----------
    cost : callable
        Of a set of places (n,), n >= 2; the smaller the better.
    xy : ndarray, shape (p, 2)
        Where they are.
    count : int
        How many are wanted, 2 or more.
    seeds : ndarray of int, shape (k,)
        Places of which all pairs are tried; growth and exchange try all places.
    show : callable
        Shows progress.

    Returns
    -------
    ndarray of int, shape (count,)
        From left to right.

    """
    pairs = [np.array(pair, dtype=np.intp) for pair in combinations(seeds, 2)]
    chosen, _ = _best(cost, pairs, 'pairs', show)
    while len(chosen) < count:
        grown = [np.append(chosen, k) for k in range(len(xy)) if k not in chosen]
        chosen, _ = _best(cost, grown, f'place {len(chosen) + 1}', show)
    return exchange(cost, xy, chosen, show)


def exchange(
    cost: Cost, xy: FloatArray, start: IndexArray, show: Show, *, local: bool = False
) -> IndexArray:
    """
    Exchange one place at a time as long as that makes the cost notably smaller.

    Parameters
    ----------
    cost, xy, show : callable, ndarray, callable
        As for `best_places`.
    start : ndarray of int, shape (n,)
        Places to start from.
    local : bool
        Try in exchange for a place only those that lie nearer to it than to the others.

    Returns
    -------
    ndarray of int, shape (n,)
        From left to right: the order has no meaning, and so the same set reads the same.

    """
    chosen, least = start, cost(start)
    around = np.linalg.norm(xy[:, None] - xy[start], axis=-1).argmin(axis=1)
    for _ in range(_MAX_ROUNDS):
        before = least
        for k in range(len(chosen)):
            others = np.delete(chosen, k)
            # The one taken out comes first: among equals nothing is changed.
            near = np.flatnonzero(around == k) if local else range(len(xy))
            rest = [j for j in near if j not in chosen]
            swapped = [np.append(others, j) for j in (chosen[k], *rest)]
            best, least = _best(cost, swapped, 'exchange', show)
            chosen = np.insert(others, k, best[-1])
        if least > (1.0 - _LEAST_GAIN) * before:
            break
    return chosen[np.lexsort(xy[chosen].T[::-1])]


def spread(xy: FloatArray, most: int) -> IndexArray:
    """About `most` of points (p, 2) that lie far from each other (Gonzalez, 1985)."""
    chosen = [int(np.argmin(xy.sum(axis=1)))]
    distance = np.full(len(xy), np.inf)
    while len(chosen) < min(most, len(xy)):
        distance = np.minimum(distance, np.linalg.norm(xy - xy[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen, dtype=np.intp)


def _best(cost: Cost, sets: list[IndexArray], what: str, show: Show) -> tuple[IndexArray, float]:
    costs = [cost(places) for places in show(sets, what, len(sets))]
    best = int(np.argmin(costs))
    return sets[best], costs[best]


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
