"""
Acquisition planning: where to take panoramas so that the robot will know its place everywhere.

Livatino and Madsen announce a simulator for this; here the errors are propagated instead, from
the papers' edges to the panoramas' poses, from there to landmarks, and on to the robot's place.
Without papers, poses are as exact to each other as panoramas give them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.reference_area import LEAST_PAPERS
from landmark_nav.planning.config import PlanConfig
from landmark_nav.planning.prediction import Predictor
from landmark_nav.planning.search import (
    best_places,
    exchange,
    left_right_layout,
    random_sets,
    Show,
    spread,
)
from landmark_nav.planning.views import (
    ahead_rad,
    free_floor,
    is_free,
    look,
    sample_walls,
    sweep_poses,
    turns_rad,
)
from landmark_nav.types import FloatArray

# How finely a room is looked at, at most: it bounds time and memory in halls.
_MOST_PLACES = 220
_MOST_SEEDS = 32
_MOST_SAMPLES = 130
_SEARCH_SAMPLES = 70
_SEARCH_CELLS = 70
_REFINE_CELLS = 150
_REPORT_CELLS = 900
_MAP_CELLS = 6000
_MAP_SPACING_M = 0.1

# Steps from a grid point towards the next one when places are refined.
_REFINEMENT = 3

# Distances of L and R from the middle, shares of the room's extent, the widest first.
_SHARES = (0.25, 0.2, 0.15, 0.1, 0.07)


@dataclass(frozen=True, eq=False)
class Forecast:
    """
    What panoramas at given places would be worth.

    Parameters
    ----------
    poses_map_base : ndarray, shape (n, 3)
        Where the robot stands.
    pose_covariance : ndarray, shape (n, 3, 3)
        Of the pan axis' x, y and heading as papers or panoramas give them.
    landmarks : float
        How many are to be expected.
    landmark_sigma_m : float
        Root of the mean squared distance of a landmark from its true place, in plan.
    floor_xy, sigma_m : ndarray, shape (c, 2), (c,)
        Cells of the free floor, and the localization error there, root of the trace; inf where
        too few landmarks would be seen.
    cost_m : float
        Mean error over the floor, with the planner's cap.

    """

    poses_map_base: FloatArray
    pose_covariance: FloatArray
    landmarks: float
    landmark_sigma_m: float
    floor_xy: FloatArray
    sigma_m: FloatArray
    cost_m: float

    def quantile_m(self, share: float) -> float:
        """Localization error that `share` of the floor does not exceed."""
        return float(np.quantile(self.sigma_m, share, method='inverted_cdf'))


@dataclass(frozen=True, eq=False)
class Plan:
    """
    Proposed places and what they are compared with.

    `best` is the proposal; `accuracy_map` the same on a finer floor, to be drawn; `left_right`
    the layout of Livatino and Madsen, None where the room does not allow it; `random` are random
    sets, the best first.
    """

    best: Forecast
    accuracy_map: Forecast
    left_right: Forecast | None
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
    Propose places for panoramas.

    Parameters
    ----------
    mount : PanTiltMount
        Where the camera turns on the robot.
    count : int
        How many places, 2 or more.
    rng : numpy.random.Generator
        Draws the random sets; the proposal depends on it only if one of these is the best.
    show : callable
        Shows progress: passes items through, with what is done and how many there are.

    Raises
    ------
    LandmarkNavError
        Fewer than two places, one or two papers, or no places from which papers are seen.
    """
    _check(room, count)
    floor = free_floor(room, config.clearance_m, config.spacing_m, _MOST_PLACES)
    if not len(floor):
        raise LandmarkNavError(
            f'no floor is {config.clearance_m:g} m away from all walls: the room is too small '
            'for this clearance'
        )
    samples = sample_walls(room, config.spacing_m, _SEARCH_SAMPLES)
    turns = turns_rad(mount, config)
    poses = np.concatenate([sweep_poses(floor, room, turn) for turn in turns])
    views = look(poses, samples, room, mount, config)
    if len(views) < count:
        words = (
            f'see {_enough(room)} papers whole, {count} are needed: hang the papers lower, larger '
            'or nearer to each other'
            if room.papers
            else f'are there, {count} are needed: give a smaller clearance'
        )
        raise LandmarkNavError(f'{len(views)} places on the free floor {words}')
    xy = views.pose_map_base[:, :2]
    cells = free_floor(room, config.clearance_m, config.spacing_m, _SEARCH_CELLS)
    cost = Predictor(views, samples, cells, room, config).cost_m
    seeds = spread(_spread_out(views.pose_map_base) if len(turns) > 1 else xy, _MOST_SEEDS)
    chosen = views.pose_map_base[best_places(cost, xy, count, seeds, show)]
    left_right = _left_right(room, mount, count, config)
    starts = [chosen]
    if left_right is not None and len(left_right) == count:
        starts.append(left_right)
    sets = [_refined(start, floor, room, mount, config, show) for start in starts]
    if left_right is not None:
        sets.append(left_right)
    drawn = random_sets(xy, count, config.random_sets, rng)
    sets += [views.pose_map_base[k] for k in drawn]
    cells = free_floor(room, config.clearance_m, config.spacing_m, _REPORT_CELLS)
    forecasts = forecast(sets, cells, room, mount, config)
    # What it is compared with may be better: it was found on coarser floor.
    rivals = [f for f in forecasts if len(f.poses_map_base) == count]
    best = min(rivals, key=lambda f: f.cost_m)
    if not np.isfinite(best.cost_m) or not best.landmarks:
        raise LandmarkNavError(
            f'no {count} places see the same walls well enough to learn landmarks: '
            'check the walls in room.yaml'
        )
    cells = free_floor(room, config.clearance_m, _MAP_SPACING_M, _MAP_CELLS)
    return Plan(
        best,
        forecast([best.poses_map_base], cells, room, mount, config)[0],
        None if left_right is None else forecasts[len(starts)],
        tuple(sorted(forecasts[-len(drawn) :], key=lambda f: f.cost_m)),
    )


def forecast(
    sets: Sequence[FloatArray],
    cells: FloatArray,
    room: Room,
    mount: PanTiltMount,
    config: PlanConfig,
) -> list[Forecast]:
    """
    Predict what sets of places are worth.

    Parameters
    ----------
    sets : sequence of ndarray, shape (n, 3)
        Poses of the base, two or more, all in view of the papers, if there are any.
    cells : ndarray, shape (c, 2)
        Floor on which to predict.
    room, mount, config : Room, PanTiltMount, PlanConfig
        As for `plan_positions`.

    Returns
    -------
    list of Forecast
        In the order of `sets`.

    Raises
    ------
    LandmarkNavError
        A place does not see enough papers.

    """
    samples = sample_walls(room, config.spacing_m, _MOST_SAMPLES)
    poses = np.concatenate(sets)
    views = look(poses, samples, room, mount, config)
    if len(views) < len(poses):
        raise LandmarkNavError(
            f'{len(poses) - len(views)} of {len(poses)} places do not see {_enough(room)} papers'
        )
    predictor = Predictor(views, samples, cells, room, config)
    ends = np.cumsum([len(places) for places in sets])
    forecasts = []
    for places, end in zip(sets, ends, strict=True):
        index = np.arange(end - len(places), end)
        prediction = predictor.predict(index)
        forecasts.append(
            Forecast(
                places,
                views.covariance[index],
                float(prediction.landmarks.sum()),
                prediction.landmark_sigma_m,
                cells,
                prediction.sigma_m,
                prediction.cost_m,
            )
        )
    return forecasts


def _refined(
    chosen: FloatArray,
    floor: FloatArray,
    room: Room,
    mount: PanTiltMount,
    config: PlanConfig,
    show: Show,
) -> FloatArray:
    """Poses (n, 3), moved between the points of the grid that they are from."""
    turn = chosen[:, 2] - ahead_rad(chosen[:, :2], room)
    gaps = np.linalg.norm(floor[:, None] - floor, axis=-1)
    spacing = np.min(gaps, where=gaps > 0.0, initial=1.0)
    step = np.linspace(-1.0, 1.0, 2 * _REFINEMENT + 1) * spacing * (1.0 - 0.5 / _REFINEMENT)
    moves = np.stack(np.meshgrid(step, step), -1).reshape(-1, 2)
    moves = moves[np.argsort(np.linalg.norm(moves, axis=1), kind='stable')]
    near = (moves[:, None] + chosen[:, :2]).reshape(-1, 2)  # the first are the chosen themselves
    near = sweep_poses(near, room, np.tile(turn, len(moves)))
    near = near[is_free(room, config.clearance_m, near[:, :2])]
    samples = sample_walls(room, config.spacing_m, _MOST_SAMPLES)
    views = look(near, samples, room, mount, config)
    cells = free_floor(room, config.clearance_m, config.spacing_m, _REFINE_CELLS)
    cost = Predictor(views, samples, cells, room, config).cost_m
    xy = views.pose_map_base[:, :2]
    return views.pose_map_base[exchange(cost, xy, np.arange(len(chosen)), show, local=True)]


def _spread_out(poses: FloatArray) -> FloatArray:
    """Points (n, 4) for poses (n, 3): a turn by a radian is as far as a metre."""
    return np.column_stack([poses[:, :2], np.cos(poses[:, 2]), np.sin(poses[:, 2])])


def _left_right(
    room: Room, mount: PanTiltMount, count: int, config: PlanConfig
) -> FloatArray | None:
    """Poses (k, 3) of the widest layout of Livatino and Madsen that sees the papers."""
    samples = sample_walls(room, config.spacing_m, _SEARCH_SAMPLES)
    for share in _SHARES:
        xy = left_right_layout(room, count, share, config)
        if len(xy):
            poses = sweep_poses(xy, room, turns_rad(mount, config)[0])
            if len(look(poses, samples, room, mount, config)) == len(poses):
                return poses
    return None


def _check(room: Room, count: int) -> None:
    if count < 2:
        raise LandmarkNavError(
            f'positions: {count}: landmarks are learned from two places or more'
        )
    if 0 < len(room.papers) < LEAST_PAPERS:
        raise LandmarkNavError(
            f'the room names {len(room.papers)} reference papers: list three in room.yaml, which '
            'give the pose of a panorama, or none'
        )


def _enough(room: Room) -> str:
    """How many papers a place must see, in words."""
    count = len(room.papers)
    return f'all {count}' if count == LEAST_PAPERS else f'{LEAST_PAPERS} of {count}'
