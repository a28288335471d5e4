"""Walls of the plan against patches located by stereo."""

from dataclasses import replace

from builders import walls_of
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment.problem import AdjustmentConfig
from landmark_nav.learning.adjustment.solution import Adjustment
from landmark_nav.learning.adjustment.wall_fit import (
    check_walls,
    moved_walls,
    wall_warnings,
    WallResidual,
)

FOOTPRINT = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]])
ROOM = Room(walls_of(FOOTPRINT, ('south', 'east', 'north', 'west')))
CONFIG = AdjustmentConfig()


def placed(south, along, shared_m=0.001):
    """Patches so far before the south wall; flat posters hang on the north wall."""
    x = np.concatenate([along, np.linspace(0.5, 5.5, 8)])
    y = np.concatenate([south, np.full(8, 3.99)])
    count = len(x)
    loading = np.zeros((count, 3, 1))
    loading[:, 1] = shared_m
    return Adjustment(
        positions=np.column_stack([x, y, np.full(count, 1.5)]),
        own_covariance=np.tile(np.eye(3) * 0.003**2, (count, 1, 1)), shared_loading=loading,
        poses=np.zeros((2, 4)), pose_covariance=np.zeros((2, 4, 4)),
        off_wall_m=np.where(np.arange(count) < len(along), y, 4.0 - y), chi_square=np.zeros(count),
        noise=np.ones(4),
    )  # fmt: skip


def check(south, along, **options):
    free = placed(south, along, **options)
    walls = [0] * len(along) + [2] * 8
    return check_walls(free, walls, ROOM, CONFIG)


ALONG = np.linspace(0.5, 5.5, 12)
NOISE = np.random.default_rng(0).normal(0.0, 0.003, 12)

# Frames of unequal depth: two patches on each of seven images.
ON_POSTERS = np.repeat(np.linspace(0.6, 5.4, 7), 2) + np.tile([-0.1, 0.1], 7)
FRAMES = np.repeat([0.0, 0.03, 0.01, 0.028, 0.0, 0.025, 0.015], 2)
TWO_IMAGES = np.repeat([2.0, 3.2], 6) + np.tile(np.linspace(-0.1, 0.1, 6), 2)
FURNITURE = np.array([0.0, 0.3, 0.12, 0.02, 0.4, 0.18, 0.06, 0.15, 0.01, 0.1, 0.25, 0.5])
ROUGH = np.random.default_rng(1).uniform(-0.05, 0.05, 12)


@pytest.mark.parametrize(
    ('south', 'along', 'shared_m'),
    [
        (NOISE, ALONG, 0.001),
        (0.02 + NOISE, ALONG, 0.001),
        (0.04 + NOISE, ALONG, 0.001),
        # Pose errors of the panoramas are not blamed on the wall.
        (-0.05 + NOISE, ALONG, 0.015),
        # Furniture states nothing about it, nor does what is far off, or rough.
        (FURNITURE, ALONG, 0.001),
        (np.full(12, 0.07), np.linspace(2.0, 2.8, 12), 0.001),
        # A long shelf under images, and boxes.
        (np.append(np.full(24, 0.35), [0.02, 0.01, 0.02]), np.linspace(0.5, 5.5, 27), 0.001),
        (np.resize([0.3, 0.45, 0.38, 0.5, 0.22], 20), np.linspace(0.5, 5.5, 20), 0.001),
        # What lies farther off than a room is measured wrong is another room, or a mirror's.
        (np.full(24, -2.0), np.linspace(0.5, 5.5, 24), 0.001),
        (ROUGH, ALONG, 0.001),
        (FRAMES, ON_POSTERS, 0.001),
        # Two images are too few to state that a wall is turned.
        (np.repeat([0.0, 0.05], 6), TWO_IMAGES, 0.001),
        (np.repeat([0.0, 0.05], 6) - 0.05, TWO_IMAGES, 0.001),
    ],
)
def test_a_wall_that_may_fit_is_not_reported(south, along, shared_m):
    assert not check(south, along, shared_m=shared_m)


@pytest.mark.parametrize(
    ('south', 'along', 'words'),
    [
        (0.07 + NOISE * 0.1, ALONG, r'do not fit.*south has its 12 patches 7\.0 cm before'),
        (-0.05 + NOISE * 0.1, ALONG, r'12 patches 5\.0 cm behind'),
        (np.tan(np.radians(3.0)) * (ALONG - 3.0), ALONG, r'south is turned by 3\.0 deg'),
        (
            np.tan(np.radians(3.0)) * (ON_POSTERS - 3.0) + FRAMES,
            ON_POSTERS,
            r'south is turned by [23]\.\d deg',
        ),
        # Positions far from the assumed wall are less certain.
        (-0.6 + ROUGH, ALONG, 'has its 12 patches .* cm behind'),
        # Behind a wall that is given too near stands nothing but the wall, whatever is before it.
        (
            np.append(np.full(12, -0.7), np.full(6, 0.01)),
            np.append(ALONG, ALONG[:6]),
            r'12 patches 70\.0 cm behind',
        ),
    ],
)
def test_a_wall_that_is_elsewhere_is_named_with_its_residuals(south, along, words):
    with pytest.raises(LandmarkNavError, match=words):
        check(south, along)


def warning(off_cm, shared_m=0.002, hanging_m=0.001):
    """What is said of four walls whose patches hang so far before them."""
    walls = [
        WallResidual(name, 20, 5, off / 100.0, shared_m * np.eye(4)[k])
        for k, (name, off) in enumerate(zip('abcd', off_cm, strict=True))
    ]
    return wall_warnings(walls, hanging_m, CONFIG)


def test_walls_measured_with_a_tape_are_not_flagged():
    rng = np.random.default_rng(3)
    common = abs(rng.normal(0.0, 1.5, 1000))
    off = common[:, None] + rng.normal(0.0, np.hypot(0.5, 0.2), (1000, 4))
    inflated = [bool(warning(list(room))) for room in off]
    # One in a thousand for what they are beside each other, and for three sigmas of all of them.
    assert np.sum(inflated) <= 10


def test_what_lies_before_a_wall_may_hang_so_what_lies_behind_it_may_not():
    assert 'may hang' in warning([7.0, 0.2, 0.3, 0.4])
    assert 'may hang' not in warning([-7.0, 0.2, 0.3, 0.4])
    assert warning([3.0, 0.2, 1.0, 0.4])
    assert not warning([3.0, 0.2, 1.0, 0.4], hanging_m=0.03)
    assert not warning([3.0, 0.2, 1.0, 0.4], shared_m=0.02)
    assert not wall_warnings([], 0.001, CONFIG)


def room_of(corners, sigma_m):
    return Room(walls_of(corners, sigma_m=sigma_m))


def patches(rng, outliers=3, corners=FOOTPRINT):
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
def test_walls_that_are_off_move_to_their_patches(seed):
    rng = np.random.default_rng(seed)
    free, walls = patches(rng)
    given = room_of(FOOTPRINT + rng.uniform(-0.1, 0.1, FOOTPRINT.shape), 0.1)
    moved, _ = moved_walls(free, walls, given, CONFIG)
    found = np.array([wall.start for wall in moved.walls])
    assert np.abs(found - FOOTPRINT).max() < 0.025
    assert all(wall.sigma_m and wall.sigma_m < 0.05 for wall in moved.walls)


@pytest.mark.parametrize('slanted', [False, True])
def test_a_short_wall_with_relief_is_at_a_right_angle_unless_it_is_not(slanted):
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


def test_walls_that_are_measured_or_show_nothing_stay():
    free, walls = patches(np.random.default_rng(5))
    off = FOOTPRINT + np.array([0.1, 0.0])
    measured = room_of(off, None)
    assert moved_walls(free, walls, measured, CONFIG) == (measured, 0.0)
    right = room_of(FOOTPRINT, 0.1)
    assert moved_walls(free, walls, right, CONFIG)[1] < CONFIG.hanging_sigma_m
    bare = replace(free, positions=free.positions[:0], own_covariance=free.own_covariance[:0])
    given = room_of(off, 0.1)
    assert moved_walls(bare, [], given, CONFIG) == (given, 0.0)
