"""Rooms without a plan whose walls are bare: furniture, mirror, window, posters that repeat."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scenes import (
    Board,
    draw_panorama,
    flat_texture,
    rectangle_room,
    Scene,
    smooth_texture,
    wall_board,
)

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.learning.pipeline import LearningConfig
from landmark_nav.learning.unmeasured import learn_located, locate, UnmeasuredConfig
from landmark_nav.types import PlaceChain

CONFIG = UnmeasuredConfig()
GREY = (150.0, 150.0, 150.0)
EYE_M = 1.2
POSES = np.array([[0.0, 0.0, 0.0], [1.3, 0.5, 0.7]])
# Around the first sweep, which is the frame.
MIDDLE = np.array([2.4, 2.0])


def walls(width_m=5.0, depth_m=4.0):
    """Bare walls of a room about both sweeps."""
    room = rectangle_room(width_m, depth_m)
    return [moved(wall_board(wall, flat_texture(GREY))) for wall in room.walls]


def moved(board):
    return replace(board, center=board.center - [*MIDDLE, 0.0])


def board(xyz, seed, size_m=0.6, turn_rad=0.0):
    """A textured front at xyz that is turned from facing the first sweep."""
    center = np.array(xyz)
    toward = se2.rotation(turn_rad) @ (-center[:2] / np.hypot(*center[:2]))
    texture = smooth_texture(np.random.default_rng(seed), size_m, size_m, 0.05)
    return Board(center, np.append(toward, 0.0), size_m, size_m, texture)


@cache
def furniture(count=14, alike=False):
    """Fronts all around, none of them on a wall."""
    rng = np.random.default_rng(3)
    made = []
    for k in range(count):
        azimuth = 2.0 * np.pi * (k + rng.uniform(-0.2, 0.2)) / count
        reach = rng.uniform(1.5, 1.9)
        at = (*(reach * np.array([np.cos(azimuth), np.sin(azimuth)])), rng.uniform(0.95, 1.45))
        turn = 0.0 if alike else rng.uniform(-0.5, 0.5)
        made.append(board(at, 11 if alike else 20 + k, turn_rad=turn))
    return tuple(made)


@cache
def furnished():
    return Scene((*walls(), *furniture()))


def learned(scenes, known=POSES):
    rng = np.random.default_rng(1)
    panoramas = [
        draw_panorama(scene, np.array([*pose[:2], EYE_M]), float(pose[2]), rng=rng)
        for scene, pose in zip(scenes, POSES, strict=True)
    ]
    sigma = np.array([0.0, 0.0, 0.0, 0.03, 0.03, 0.02])
    lever = np.array([0.0, 0.0, EYE_M])
    chain = PlaceChain(known, np.diag(sigma**2))
    return learn_located(locate(panoramas, [chain], lever, CONFIG), LearningConfig())


def learned_or_refused(scene, boards, known=POSES, scale_off=0.06):
    """Why there is no map, in one line; nothing where there is a right one."""
    try:
        result = learned([scene, scene], known)
    except LandmarkNavError as refused:
        return str(refused)
    check(result, boards, scale_off)
    return ''


def check(result, boards, scale_off=0.06):
    """Every landmark lies on a board, as well as it says; poses are right but for the scale."""
    way, true = result.panoramas[1].center_map[:2], POSES[1, :2]
    scale = float(np.hypot(*way) / np.hypot(*true))
    assert abs(scale - 1.0) < scale_off
    assert abs(wrap_rad(result.panoramas[1].heading_rad - POSES[1, 2])) < np.radians(0.4)
    turn = np.arctan2(way[1], way[0]) - np.arctan2(true[1], true[0])
    assert abs(wrap_rad(turn)) < np.radians(1.0)
    wrong = 0
    for landmark in result.map.landmarks:
        up = EYE_M + (landmark.position[2] - EYE_M) / scale
        place = np.array([*(landmark.position[:2] / scale), up])
        reach = 0.5 * landmark.width_m
        away = [(place - b.center, b) for b in boards]
        off = [max(abs(v @ b.normal), abs(v @ b.right) - 0.5 * b.width_m - reach) for v, b in away]
        wrong += min(off) > 0.02 + 3.0 * np.sqrt(np.linalg.eigvalsh(landmark.covariance)[-1])
    assert wrong == 0


def test_furniture_makes_a_map_of_a_room_with_bare_walls():
    result = learned([furnished()] * 2)
    assert len(result.map.landmarks) >= 15
    assert any(not landmark.wall_id for landmark in result.map.landmarks)
    check(result, furniture())


@pytest.mark.parametrize('count', [6, 14])
def test_posters_that_repeat_make_a_right_map_or_none(count):
    boards = furniture(count, alike=True)
    scene = Scene((*walls(), *boards))
    assert '\n' not in learned_or_refused(scene, boards)


def test_odometry_that_slipped_aside_makes_a_right_map_or_none():
    slipped = POSES + np.array([[0.0, 0.0, 0.0], [-0.18, 0.46, 0.0]])
    refused = learned_or_refused(furnished(), furniture(), slipped, scale_off=0.5)
    assert not refused or 'odom' in refused


def test_what_a_mirror_or_a_window_shows_is_where_it_seems():
    """An opening shows a second room, as a mirror does, or what is far away: no landmark."""
    behind = tuple(board((3.6 + 0.2 * k, -1.2 + 0.8 * k, 1.2), 60 + k) for k in range(3))
    texture = smooth_texture(np.random.default_rng(5), 80.0, 12.0, 1.0)
    far = Board(np.array([40.0, 0.0, 1.5]), np.array([-1.0, 0.0, 0.0]), 80.0, 12.0, texture)
    bare = walls()
    for beyond, near in ((behind, behind), ((far,), ())):
        scene = Scene((bare[0], *bare[2:], *furniture(), *beyond))
        check(learned([scene, scene]), (*furniture(), *near))


@pytest.mark.parametrize('ends', [False, True])
def test_a_corridor_with_bare_walls_makes_a_right_map_or_none(ends):
    boards = (board((4.5, 0.2, 1.2), 81, 1.2), board((-2.5, 0.1, 1.2), 82, 1.2)) if ends else ()
    scene = Scene((*walls(12.0, 4.6)[::2], *boards))
    assert '\n' not in learned_or_refused(scene, boards)
