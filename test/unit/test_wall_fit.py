"""The wall map against patches that stereo placed."""

from __future__ import annotations

import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.learning.adjustment import Adjustment, AdjustmentConfig
from landmark_nav.learning.adjustment.wall_fit import (
    check_walls,
    wall_residuals,
    wall_warnings,
    WallResidual,
)

CORNERS = [(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)]
ROOM = Room(
    tuple(
        Wall(name, CORNERS[k], CORNERS[(k + 1) % 4], 2.5)
        for k, name in enumerate(('south', 'east', 'north', 'west'))
    )
)


def placed(south: np.ndarray, along: np.ndarray, shared_m: float = 0.001) -> Adjustment:
    """Patches so far before the south wall; flat posters hang on the north wall."""
    x = np.concatenate([along, np.linspace(0.5, 5.5, 8)])
    y = np.concatenate([south, np.full(8, 3.99)])
    count = len(x)
    loading = np.zeros((count, 3, 1))
    loading[:, 1] = shared_m
    return Adjustment(
        positions=np.column_stack([x, y, np.full(count, 1.5)]),
        own_covariance=np.tile(np.eye(3) * 0.003**2, (count, 1, 1)),
        shared_loading=loading,
        poses=np.zeros((2, 4)),
        pose_covariance=np.zeros((2, 4, 4)),
        off_wall_m=np.where(np.arange(count) < len(along), y, 4.0 - y),
        chi_square=np.zeros(count),
        noise=np.ones(4),
    )


def check(south: np.ndarray, along: np.ndarray, **options: float) -> str:
    free = placed(south, along, **options)
    walls = [0] * len(along) + [2] * 8
    return check_walls(free, walls, ROOM, AdjustmentConfig())


ALONG = np.linspace(0.5, 5.5, 12)
NOISE = np.random.default_rng(0).normal(0.0, 0.003, 12)


@pytest.mark.parametrize('hanging_m', [0.0, 0.02, 0.04])
def test_what_hangs_on_a_wall_fits_it(hanging_m: float) -> None:
    check(hanging_m + NOISE, ALONG)


@pytest.mark.parametrize(('off_m', 'words'), [(0.07, '7.0 cm before'), (-0.05, '5.0 cm behind')])
def test_a_wall_that_is_elsewhere_is_named_with_its_residuals(off_m: float, words: str) -> None:
    with pytest.raises(LandmarkNavError, match=rf'do not fit.*south has its 12 patches {words}'):
        check(off_m + NOISE * 0.1, ALONG)


def test_a_turned_wall_is_named() -> None:
    with pytest.raises(LandmarkNavError, match=r'south is turned by 3\.0 deg'):
        check(np.tan(np.radians(3.0)) * (ALONG - 3.0) + NOISE * 0.1, ALONG)


def test_pose_errors_of_the_panoramas_are_not_blamed_on_the_wall() -> None:
    check(-0.05 + NOISE, ALONG, shared_m=0.015)


def test_furniture_before_a_wall_states_nothing_about_it() -> None:
    depths = np.array([0.0, 0.3, 0.12, 0.02, 0.4, 0.18, 0.06, 0.15, 0.01, 0.1, 0.25, 0.5])
    check(depths, ALONG)
    check(np.full(12, 0.07), np.linspace(2.0, 2.8, 12))


@pytest.mark.parametrize(
    ('off_m', 'words'),
    [
        (0.21, 'south has its 12 patches 21.0 cm before'),
        (0.4, 'south has its 12 patches 40.0 cm before .* furniture hides it'),
        (1.0, 'south has its 12 patches 100.0 cm before'),
        (-0.3, 'south has its 12 patches 30.0 cm behind'),
        (-1.0, 'south has its 12 patches 100.0 cm behind'),
    ],
)
def test_a_wall_that_is_far_elsewhere_is_reported_no_less(off_m: float, words: str) -> None:
    with pytest.raises(LandmarkNavError, match=words):
        check(off_m + NOISE * 0.1, ALONG)
    # With boxes before it, too.
    boxes = np.array([off_m + 0.3, off_m + 0.5])
    with pytest.raises(LandmarkNavError, match=words):
        check(np.append(off_m + NOISE * 0.1, boxes), np.append(ALONG, [2.5, 4.0]))


def test_fronts_of_furniture_are_not_the_wall() -> None:
    # Along less than half of a wall with nothing on it a shelf is likelier; it may be the wall.
    reported = check(np.full(24, 0.35), np.linspace(1.0, 3.9, 24))
    assert 'may be wrong: south has its 24 patches 35.0 cm before it' in reported
    assert 'or furniture hides it' in reported
    # A long one under images, and boxes.
    assert not check(np.append(np.full(24, 0.35), [0.02, 0.01, 0.02]), np.linspace(0.5, 5.5, 27))
    assert not check(np.resize([0.3, 0.45, 0.38, 0.5, 0.22], 20), np.linspace(0.5, 5.5, 20))
    # What lies farther off than a room is measured wrong is another room, or a mirror's.
    assert not check(np.full(24, -2.0), np.linspace(0.5, 5.5, 24))


def test_what_was_found_far_off_its_wall_is_known_less_well() -> None:
    rough = np.random.default_rng(1).uniform(-0.05, 0.05, 12)
    with pytest.raises(LandmarkNavError, match=r'has its 12 patches .* cm behind'):
        check(-0.6 + rough, ALONG)
    assert not check(0.0 + rough, ALONG)


def test_a_box_before_the_wall_does_not_stand_for_it() -> None:
    # Just where a wall is given that is too near: behind it nothing stands but the wall.
    with pytest.raises(LandmarkNavError, match=r'12 patches 70\.0 cm behind'):
        check(np.append(np.full(12, -0.7), np.full(6, 0.01)), np.append(ALONG, ALONG[:6]))


def warning(off_cm: list[float], shared_m: float = 0.002, hanging_m: float = 0.001) -> str:
    """What is said of four walls whose patches hang so far before them."""
    walls = [
        WallResidual(name, 20, 5, off / 100.0, shared_m * np.eye(4)[k])
        for k, (name, off) in enumerate(zip('abcd', off_cm, strict=True))
    ]
    return wall_warnings(walls, hanging_m, AdjustmentConfig())


def test_walls_measured_with_a_tape_are_not_flagged() -> None:
    rng = np.random.default_rng(3)
    common = abs(rng.normal(0.0, 1.5, 1000))
    off = common[:, None] + rng.normal(0.0, np.hypot(0.5, 0.2), (1000, 4))
    inflated = [bool(warning(list(room))) for room in off]
    # One in a thousand for what they are beside each other, and for three sigmas of all of them.
    assert np.sum(inflated) <= 10


@pytest.mark.parametrize(
    'off_cm',
    [[5.0, 0.3, 0.1, 0.4], [4.0, 0.2, 4.1, 0.0], [5.2, 5.1, 5.3, 5.2], [-3.0, -2.6, -2.8, -2.7]],
)
def test_a_room_that_is_wrong_as_a_whole_is_reported_with_its_residuals(
    off_cm: list[float],
) -> None:
    reported = warning(off_cm)
    side = 'before' if off_cm[0] > 0.0 else 'behind'
    assert f'{abs(off_cm[0]):.1f} cm {side} a' in reported
    assert all(f' {name}' in reported for name in 'abcd')


def test_things_that_hang_differently_far_flag_no_wall() -> None:
    assert warning([3.0, 0.2, 1.0, 0.4])
    assert not warning([3.0, 0.2, 1.0, 0.4], hanging_m=0.03)
    assert not warning([3.0, 0.2, 1.0, 0.4], shared_m=0.02)
    assert not wall_warnings([], 0.001, AdjustmentConfig())


# Frames of unequal depth: two patches on each of seven images.
ON_POSTERS = np.repeat(np.linspace(0.6, 5.4, 7), 2) + np.tile([-0.1, 0.1], 7)
FRAMES = np.repeat([0.0, 0.03, 0.01, 0.028, 0.0, 0.025, 0.015], 2)


def test_frames_of_unequal_depth_neither_turn_a_wall_nor_hide_that_it_is() -> None:
    check(FRAMES, ON_POSTERS)
    with pytest.raises(LandmarkNavError, match=r'south is turned by [23]\.\d deg'):
        check(np.tan(np.radians(3.0)) * (ON_POSTERS - 3.0) + FRAMES, ON_POSTERS)


def test_two_images_are_too_few_to_state_that_a_wall_is_turned() -> None:
    along = np.repeat([2.0, 3.2], 6) + np.tile(np.linspace(-0.1, 0.1, 6), 2)
    check(np.repeat([0.0, 0.05], 6), along)
    check(np.repeat([0.0, 0.05], 6) - 0.05, along)


def test_walls_with_few_patches_are_reported_too() -> None:
    few = placed(np.array([0.14, 0.15, 0.145]), np.array([0.6, 3.0, 5.0]))
    walls = [0, 0, 0, *[2] * 8]
    check_walls(few, walls, ROOM, AdjustmentConfig())
    residuals = wall_residuals(few, walls, ROOM, AdjustmentConfig())
    assert {r.wall_id: r.patches for r in residuals} == {'south': 3, 'north': 8}
    reported = wall_warnings(residuals, 0.01, AdjustmentConfig())
    assert '14.5 cm before south' in reported
