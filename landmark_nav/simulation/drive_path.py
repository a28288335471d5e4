"""Planning of paths through a room, and a path follower."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import bearings
from landmark_nav.simulation.scene import Scene
from landmark_nav.types import FloatArray

_CELL_M = 0.1
_CLEARANCE_M = 0.42
_LOOK_AHEAD_M = 0.45
# Smallest clearance of a start that is part of the path.
_TIGHT_M = 0.3
# Smallest cost (about metres) of the path to the next goal of a tour.
_LEAST_LEG_M = 1.5
# Number of random goals, of which the one with the smallest turn is used; number of cells over
# which directions are computed.
_GOALS_TRIED = 12
_DIRECTION_CELLS = 6


class _FreeGrid:
    """Grid of free positions, and shortest paths between them."""

    def __init__(self, scene: Scene) -> None:
        low, high = scene.room.bounds
        axes = [np.arange(a + _CELL_M / 2, b, _CELL_M) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing='ij'), -1)
        clearance = scene.distance_to_obstacles(grid)
        free = scene.room.contains(grid) & (clearance > _CLEARANCE_M)
        number = np.full(free.shape, -1)
        number[free] = np.arange(int(free.sum()))
        self.places: FloatArray = grid[free]
        if not len(self.places):
            raise LandmarkNavError('the room is so full that the robot cannot drive in it')
        rows, columns, costs = [], [], []
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            a = number[: free.shape[0] - dx, max(0, -dy) : free.shape[1] - max(0, dy)]
            b = number[dx:, max(0, dy) : free.shape[1] - max(0, -dy)]
            linked = (a >= 0) & (b >= 0)
            rows.append(a[linked])
            columns.append(b[linked])
            # Higher cost near walls: the path may make a detour to avoid them.
            near = clearance[free][a[linked]]
            costs.append(_CELL_M * np.hypot(dx, dy) * (1.0 + 0.3 / near))
        index = (np.concatenate(rows), np.concatenate(columns))
        size = (len(self.places), len(self.places))
        self._graph = coo_matrix((np.concatenate(costs), index), shape=size).tocsr()

    def nearest(self, place_xy: npt.ArrayLike) -> int:
        """Index of the free position nearest to (2,)."""
        return int(np.argmin(np.linalg.norm(self.places - np.asarray(place_xy), axis=1)))

    def ways_from(self, start: int) -> tuple[FloatArray, npt.NDArray[np.int32]]:
        """Cost (n,) of the path to each position, and its predecessor (n,)."""
        cost, before = dijkstra(self._graph, False, start, return_predecessors=True)
        return np.asarray(cost), np.asarray(before)

    def way(self, before: npt.NDArray[np.int32], start: int, goal: int) -> FloatArray:
        """Path (n, 2) from `start` to `goal` by the predecessors of `ways_from(start)`."""
        leg = [goal]
        while leg[-1] != start:
            leg.append(int(before[leg[-1]]))
        return self.places[leg[::-1]]


def plan_tour(
    scene: Scene, start_xy: npt.ArrayLike, length_m: float, rng: np.random.Generator
) -> FloatArray:
    """
    Plan a path (n, 2) through the room, from one random position to the next.

    Its points are about 5 cm apart, corners rounded; it is at least `length_m` long, and begins at
    a free position nearby if there is an obstacle at the start. Raises `LandmarkNavError`: there
    is no space to drive.
    """
    grid = _FreeGrid(scene)
    at = grid.nearest(start_xy)
    path = [grid.places[at]]
    if scene.distance_to_obstacles(start_xy) > _TIGHT_M:
        path.insert(0, np.asarray(start_xy, dtype=np.float64))
    length = 0.0
    while length < length_m:
        cost, before = grid.ways_from(at)
        reach = np.flatnonzero(np.isfinite(cost))
        goals = reach[cost[reach] > min(_LEAST_LEG_M, 0.6 * float(cost[reach].max()))]
        if not len(goals):
            raise LandmarkNavError('the robot has no free path to any other position')
        ways = [grid.way(before, at, int(goal)) for goal in rng.choice(goals, _GOALS_TRIED)]
        points = min(ways, key=lambda way: _turn(path, way))
        length += float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        path.extend(points[1:])
        at = grid.nearest(points[-1])
    return _rounded(np.array(path))


def plan_way(scene: Scene, start_xy: FloatArray, goal_xy: FloatArray) -> FloatArray:
    """
    Plan the path (n, 2) from one position to another, as `plan_tour` does.

    Raises `LandmarkNavError`: there is no path between them.
    """
    grid = _FreeGrid(scene)
    start, goal = grid.nearest(start_xy), grid.nearest(goal_xy)
    cost, before = grid.ways_from(start)
    if not np.isfinite(cost[goal]):
        (x, y), (u, v) = start_xy, goal_xy
        ends = f'({x:.2f}, {y:.2f}) to ({u:.2f}, {v:.2f})'
        raise LandmarkNavError(f'there is no way from {ends} for the robot')
    way = grid.way(before, start, goal)
    return _rounded(np.vstack([np.asarray(start_xy)[None], way, np.asarray(goal_xy)[None]]))


def _turn(path: list[FloatArray], way: FloatArray) -> float:
    """Angle between the final direction of `path` and the initial direction of `way` (n, 2)."""
    arrival = path[-1] - path[max(len(path) - _DIRECTION_CELLS, 0)]
    departure = way[min(_DIRECTION_CELLS, len(way) - 1)] - way[0]
    angles = np.arctan2([arrival[1], departure[1]], [arrival[0], departure[0]])
    return abs(float(wrap_rad(angles[1] - angles[0])))


def _rounded(path: FloatArray) -> FloatArray:
    """Path with its corners smoothed over about half a metre, resampled evenly."""
    step = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(np.maximum(step, 1e-9))])
    even = np.arange(0.0, along[-1], 0.05)
    points = np.stack([np.interp(even, along, path[:, k]) for k in (0, 1)], -1)
    window = np.hanning(11)[1:-1]
    half = len(window) // 2
    padded = np.pad(points, [(half, half), (0, 0)], mode='edge')
    return np.stack(
        [np.convolve(padded[:, k], window / window.sum(), 'valid') for k in (0, 1)], -1
    )


class PathFollower:
    """
    Steers a base along a path (n, 2).

    It aims at a point ahead on the path (Coulter, Implementation of the pure pursuit path tracking
    algorithm, 1992). If that point is far to the side, it slows down or turns in place.
    """

    def __init__(self, path_xy: FloatArray, speed_m_s: float) -> None:
        self._path = np.asarray(path_xy, dtype=np.float64)
        self._speed_m_s = speed_m_s
        self._at = 0

    @property
    def finished(self) -> bool:
        """Whether the end has been reached."""
        return self._at >= len(self._path) - 1

    def command(self, pose_map_base: FloatArray) -> tuple[float, float]:
        """Speed [m/s] and turning rate [rad/s] for a pose (3,)."""
        ahead = self._path[self._at : self._at + 60] - pose_map_base[:2]
        distance = np.linalg.norm(ahead, axis=1)
        self._at += int(np.argmin(distance[:25]))
        if self.finished:
            return 0.0, 0.0
        distance = np.linalg.norm(self._path[self._at :] - pose_map_base[:2], axis=1)
        beyond = np.flatnonzero(distance > _LOOK_AHEAD_M)
        goal = self._path[self._at + (int(beyond[0]) if len(beyond) else len(distance) - 1)]
        error = float(bearings(pose_map_base, goal))
        reach = max(float(np.linalg.norm(goal - pose_map_base[:2])), 0.2)
        if abs(error) > 1.0:
            return 0.0, float(np.clip(1.5 * error, -0.8, 0.8))
        speed = self._speed_m_s * max(np.cos(1.3 * error), 0.15)
        return float(speed), float(2.0 * speed * np.sin(error) / reach)
