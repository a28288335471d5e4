"""
Acquisition planning: positions of panoramas that give the best localization on the whole floor.

Livatino and Madsen announce a simulator for this. Here errors are propagated instead, from the
edges of papers or markers to the poses of panoramas, from there to landmarks, and on to the pose
of the robot. Without them, the relative poses of panoramas come from the panoramas themselves.

Search: the best of some random sets, then exchange of one position at a time (Fedorov, Theory of
Optimal Experiments, 1972).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IndexArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.reference_area.common_errors import least_in_view
from landmark_nav.planning.prediction import Forecast, Predictor
from landmark_nav.planning.views import (
    free_floor,
    look,
    PlanConfig,
    sample_walls,
    sweep_poses,
)
from landmark_nav.types import FloatArray

# Cost of a set of positions, by their indices (n,).
Cost = Callable[[IndexArray], float]

# Passes items through and shows progress: items, description, number of items.
Show = Callable[[Iterable[IndexArray], str, int], Iterator[IndexArray]]

_MAX_ROUNDS = 12
# Exchange ends after a round with a smaller relative gain.
_MIN_GAIN = 0.004
# A cost takes time by the square of the number of positions. This number of costs of one position,
# some 10 s, bounds a round: of more, each second place, or fewer, is tried, others in the next.
_ROUND_WORK = 300_000


def exchange(cost: Cost, xy: FloatArray, start: IndexArray, show: Show) -> IndexArray:
    """
    Exchange one position at a time while that lowers the cost by more than `_MIN_GAIN`.

    `cost` is that of two or more indices of `xy` (p, 2). Returns indices from left to right, so
    that equal sets are equal arrays.
    """
    chosen, least, before = start, cost(start), np.inf
    count, places = len(start), np.arange(len(xy))
    apart = max(1, round(count**3 * (len(xy) - count) / _ROUND_WORK))
    every = [np.array(k) for _ in range(_MAX_ROUNDS) for k in range(count)]
    for step, k in enumerate(show(every, 'exchange', len(every))):
        if k == 0 and least > (1.0 - _MIN_GAIN) * before:
            break
        before = least if k == 0 else before
        others = np.delete(chosen, k)
        # The current position comes first, so that nothing changes among equal costs.
        rest = np.setdiff1d(places, chosen)[(step + step // count) % apart :: apart]
        best, least = _best(cost, [np.append(others, j) for j in (chosen[k], *rest)])
        chosen = np.insert(others, k, best[-1])
    return chosen[np.lexsort(xy[chosen].T[::-1])]


def _best(cost: Cost, sets: Iterable[IndexArray]) -> tuple[IndexArray, float]:
    return min(((places, cost(places)) for places in sets), key=itemgetter(1))


# Smallest distance between two random positions: learning refuses nearer ones.
_MIN_DISTANCE_M = 0.5


def random_sets(
    xy: FloatArray, count: int, sets: int, rng: np.random.Generator
) -> npt.NDArray[np.intp]:
    """
    Draw indices (sets, count) of random sets of positions `xy` (p, 2).

    Those of a set are different, and `_MIN_DISTANCE_M` apart if possible.
    """
    drawn = []
    for _ in range(sets):
        best = rng.choice(len(xy), count, replace=False)
        for _ in range(100):
            gaps = np.linalg.norm(xy[best][:, None] - xy[best], axis=-1)
            if np.all(gaps[np.triu_indices(count, 1)] >= _MIN_DISTANCE_M):
                break
            best = rng.choice(len(xy), count, replace=False)
        drawn.append(best)
    return np.array(drawn, dtype=np.intp)


# Largest numbers of positions, wall samples and floor cells, which bound time and memory in halls.
_MAX_POSITIONS = 220
_MAX_SAMPLES = 130
_SEARCH_SAMPLES = 70
_SEARCH_CELLS = 70
_REPORT_CELLS = 900
_MAP_CELLS = 6000
_MAP_SPACING_M = 0.1
# Number of random sets of which the best is the start of the exchange. In two rooms the result is
# within 0.1 % of that from the best pair, grown; a finer grid around it gained 0.4 % at most.
_STARTS = 100


@dataclass(frozen=True, eq=False)
class Plan:
    """
    Proposed positions, and others for comparison.

    `best` is the proposal; `accuracy_map` is the same on a finer floor, for a figure; `random` are
    random sets, the best first.
    """

    best: Forecast
    accuracy_map: Forecast
    random: tuple[Forecast, ...]


def plan_positions(
    room: Room,
    mount: PanTiltMount,
    count: int,
    config: PlanConfig,
    rng: np.random.Generator,
    show: Show = lambda items, _what, _total: iter(items),
) -> Plan:
    """
    Propose `count` positions for panoramas, 2 or more.

    The proposal depends on `rng`, which draws the random sets, only if one of these is the best.
    Raises `LandmarkNavError`: fewer than two positions, too few papers or markers in the room,
    or too few positions from which enough of them are in view.
    """
    _check(room, count)
    floor = free_floor(room, config.clearance_m, config.spacing_m, _MAX_POSITIONS)
    if not len(floor):
        raise LandmarkNavError(
            f'no floor is {config.clearance_m:g} m away from all walls: the room is too small '
            'for this clearance'
        )
    samples = sample_walls(room, config.spacing_m, _SEARCH_SAMPLES)
    poses = sweep_poses(floor, room, mount, config)
    views = look(poses, samples, room, mount, config)
    if len(views) < count:
        words = (
            f'see {_enough(room)} whole, {count} are needed: hang them lower, larger '
            'or nearer to each other'
            if room.anchors
            else f'are there, {count} are needed: give a smaller clearance'
        )
        raise LandmarkNavError(f'{len(views)} places on the free floor {words}')
    xy = views.pose_map_base[:, :2]
    cells = free_floor(room, config.clearance_m, config.spacing_m, _SEARCH_CELLS)
    cost = Predictor(views, samples, cells, room, config).cost_m
    starts = random_sets(xy, count, _STARTS, np.random.default_rng(0))
    start, _ = _best(cost, show(starts, 'places', len(starts)))
    drawn = random_sets(xy, count, config.random_sets, rng)
    sets = [views.pose_map_base[k] for k in (exchange(cost, xy, start, show), *drawn)]
    cells = free_floor(room, config.clearance_m, config.spacing_m, _REPORT_CELLS)
    forecasts = forecast(sets, cells, room, mount, config)
    # A set for comparison may be better, since the search uses a coarser floor.
    best = min(forecasts, key=lambda f: f.cost_m)
    if not np.isfinite(best.cost_m) or not best.landmarks.sum():
        raise LandmarkNavError(
            f'no {count} places see the same walls well enough to learn landmarks: '
            'check the walls in room.yaml'
        )
    cells = free_floor(room, config.clearance_m, _MAP_SPACING_M, _MAP_CELLS)
    return Plan(
        best,
        forecast([best.poses_map_base], cells, room, mount, config)[0],
        tuple(sorted(forecasts[1:], key=lambda f: f.cost_m)),
    )


def forecast(
    sets: Sequence[FloatArray],
    cells: FloatArray,
    room: Room,
    mount: PanTiltMount,
    config: PlanConfig,
) -> list[Forecast]:
    """
    Predict the results of sets of two or more poses (n, 3) of the base, on floor `cells` (c, 2).

    Raises `LandmarkNavError`: a pose does not see enough papers or markers.
    """
    samples = sample_walls(room, config.spacing_m, _MAX_SAMPLES)
    poses = np.concatenate(sets)
    views = look(poses, samples, room, mount, config)
    if len(views) < len(poses):
        raise LandmarkNavError(
            f'{len(poses) - len(views)} of {len(poses)} places do not see {_enough(room)}'
        )
    predictor = Predictor(views, samples, cells, room, config)
    ends = np.cumsum([len(places) for places in sets])
    return [
        predictor.predict(np.arange(end - len(places), end))
        for places, end in zip(sets, ends, strict=True)
    ]


def _check(room: Room, count: int) -> None:
    if count < 2:
        raise LandmarkNavError(
            f'positions: {count}: landmarks are learned from two places or more'
        )
    if len(room.anchors) < (least := least_in_view(room)):
        raise LandmarkNavError(
            f'the room names {len(room.anchors)} reference {_kind(room)}: list {least} in '
            'room.yaml, which give the pose of a panorama, or none'
        )


def _enough(room: Room) -> str:
    """Text: how many papers or markers must be in view."""
    count, least = len(room.anchors), least_in_view(room)
    return f'all {count} {_kind(room)}' if count == least else f'{least} of {count} {_kind(room)}'


def _kind(room: Room) -> str:
    return 'papers' if room.papers else 'markers'
