"""Walls with a sigma move to their patches, and no farther."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.learning.adjustment import Adjustment, AdjustmentConfig
from landmark_nav.learning.adjustment.wall_fit import moved_walls
from landmark_nav.types import FloatArray

CORNERS = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]])
CONFIG = AdjustmentConfig()


def room_of(corners: FloatArray, sigma_m: float | None) -> Room:
    ends = np.roll(corners, -1, axis=0)
    return Room(
        tuple(
            Wall(f'w{k}', tuple(start), tuple(end), 2.5, sigma_m)
            for k, (start, end) in enumerate(zip(corners.tolist(), ends.tolist(), strict=True))
        )
    )


def patches(
    rng: np.random.Generator, outliers: int = 3, corners: FloatArray = CORNERS
) -> tuple[Adjustment, list[int]]:
    """Patches that stereo placed on the walls between corners, some of each before them."""
    count = 15
    start, end = corners, np.roll(corners, -1, axis=0)
    along = (end - start) / np.linalg.norm(end - start, axis=1)[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], 1)
    walls = np.repeat(np.arange(len(corners)), count)
    share = rng.uniform(0.1, 0.9, len(walls))[:, None]
    off = rng.normal(0.0, 0.01, len(walls))
    off[np.arange(len(walls)) % count < outliers] += 0.4
    xy = start[walls] + share * (end - start)[walls] + off[:, None] * normal[walls]
    empty = np.zeros(0)
    free = Adjustment(
        np.column_stack([xy, np.full(len(xy), 1.3)]),
        np.tile(1e-4 * np.eye(3), (len(xy), 1, 1)),
        np.zeros((len(xy), 3, 0)),
        *(empty,) * 5,
    )
    return free, walls.tolist()


@pytest.mark.parametrize('seed', range(4))
def test_walls_that_are_off_move_to_their_patches(seed: int) -> None:
    rng = np.random.default_rng(seed)
    free, walls = patches(rng)
    given = room_of(CORNERS + rng.uniform(-0.1, 0.1, CORNERS.shape), 0.1)
    moved, _ = moved_walls(free, walls, given, CONFIG)
    found = np.array([wall.start for wall in moved.walls])
    assert np.abs(found - CORNERS).max() < 0.025
    assert all(wall.sigma_m and wall.sigma_m < 0.05 for wall in moved.walls)


@pytest.mark.parametrize('slanted', [False, True])
def test_a_short_wall_with_relief_is_at_a_right_angle_unless_it_is_not(slanted: bool) -> None:
    corners = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [2.0, 4.0], [0.0, 3.0]])
    if not slanted:
        corners[3:] = [[0.5, 4.0], [0.0, 4.0]]
    turns = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        free, walls = patches(rng, outliers=0, corners=corners)
        # What hangs on wall 2: thick at one end, flat at the other.
        on = np.array(walls) == 2
        before = np.where(on, 0.02 * (free.positions[:, 0] > corners[[2, 3], 0].mean()), 0.0)
        positions = free.positions - before[:, None] * [0.0, 1.0, 0.0]
        given = room_of(corners + rng.uniform(-0.03, 0.03, corners.shape), 0.05)
        moved, _ = moved_walls(replace(free, positions=positions), walls, given, CONFIG)
        along = np.array([wall.along for wall in moved.walls])
        true = np.array([wall.along for wall in room_of(corners, None).walls])
        turns.append(true[:, 0] * along[:, 1] - true[:, 1] * along[:, 0])
    assert np.degrees(np.sqrt(np.mean(np.square(turns), axis=0)))[:3].max() < 0.4
    assert np.degrees(np.abs(turns)).max() < 1.0


def test_walls_that_are_measured_or_show_nothing_stay() -> None:
    free, walls = patches(np.random.default_rng(5))
    off = CORNERS + np.array([0.1, 0.0])
    measured = room_of(off, None)
    assert moved_walls(free, walls, measured, CONFIG) == (measured, 0.0)
    assert moved_walls(free, walls, room_of(CORNERS, 0.1), CONFIG)[1] < CONFIG.hanging_sigma_m
    bare = replace(free, positions=free.positions[:0], own_covariance=free.own_covariance[:0])
    given = room_of(off, 0.1)
    assert moved_walls(bare, [], given, CONFIG) == (given, 0.0)
