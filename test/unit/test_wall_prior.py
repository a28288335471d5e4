"""Walls with a sigma move to their patches, and no farther."""

from dataclasses import replace

import numpy as np
import pytest

from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.learning.adjustment import Adjustment, AdjustmentConfig
from landmark_nav.learning.adjustment.wall_fit import moved_walls

CORNERS = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]])
CONFIG = AdjustmentConfig()


def room_of(corners, sigma_m):
    ends = np.roll(corners, -1, axis=0)
    return Room(
        tuple(
            Wall(f'w{k}', tuple(start), tuple(end), 2.5, sigma_m)
            for k, (start, end) in enumerate(zip(corners.tolist(), ends.tolist(), strict=True))
        )
    )


def patches(rng, outliers=3):
    """Patches that stereo placed on the walls of CORNERS, some of each before them."""
    count = 15
    start, end = CORNERS, np.roll(CORNERS, -1, axis=0)
    along = (end - start) / np.linalg.norm(end - start, axis=1)[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], 1)
    walls = np.repeat(np.arange(4), count)
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
def test_walls_that_are_off_move_to_their_patches(seed):
    rng = np.random.default_rng(seed)
    free, walls = patches(rng)
    given = room_of(CORNERS + rng.uniform(-0.1, 0.1, CORNERS.shape), 0.1)
    moved = moved_walls(free, walls, given, CONFIG)
    found = np.array([wall.start for wall in moved.walls])
    assert np.abs(found - CORNERS).max() < 0.025
    assert all(wall.sigma_m and wall.sigma_m < 0.05 for wall in moved.walls)


def test_walls_that_are_measured_or_show_nothing_stay():
    free, walls = patches(np.random.default_rng(5))
    off = CORNERS + np.array([0.1, 0.0])
    measured = room_of(off, None)
    assert moved_walls(free, walls, measured, CONFIG) is measured
    right = room_of(CORNERS, 0.1)
    assert moved_walls(free, walls, right, CONFIG) is right
    bare = replace(free, positions=free.positions[:0], own_covariance=free.own_covariance[:0])
    given = room_of(off, 0.1)
    assert moved_walls(bare, [], given, CONFIG) is given
