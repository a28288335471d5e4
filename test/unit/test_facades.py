"""Walls out of points: where there are some, and none where there are none."""

import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.learning.facades.outline import open_room, room_of
from landmark_nav.learning.facades.planes import find_facades, SeenPoints

EYES = np.array([[1.5, 1.5, 1.1], [3.5, 2.0, 1.1]])
RECTANGLE = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]])
ELL = np.array([[0, 0], [6, 0], [6, 2.5], [3.5, 2.5], [3.5, 4.5], [0, 4.5]], dtype=float)


def seen(xyz, sigma_m=0.01):
    covariance = np.broadcast_to(sigma_m**2 * np.eye(2), (len(xyz), 2, 2))
    return SeenPoints(xyz, covariance, np.broadcast_to(EYES[0], xyz.shape))


def on_walls(corners, rng, per_wall=60, sigma_m=0.01):
    """Points on the walls of an outline, with noise."""
    parts = []
    for start, end in zip(corners, np.roll(corners, -1, 0), strict=True):
        along = rng.uniform(0.05, 0.95, per_wall)[:, None]
        xy = start + along * (end - start) + rng.normal(0, sigma_m, (per_wall, 2))
        parts.append(np.column_stack([xy, rng.uniform(0.5, 2.2, per_wall)]))
    return np.vstack(parts)


@pytest.mark.parametrize('corners', [RECTANGLE, ELL], ids=['rectangle', 'L'])
@pytest.mark.parametrize('seed', [1, 2, 3])
def test_outline_of_a_room_is_found(corners, seed):
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-np.pi, np.pi)
    stray = np.column_stack([rng.uniform(0.5, 5.5, (40, 2)), rng.uniform(0.2, 2.2, 40)])
    xyz = np.vstack([on_walls(corners, rng), stray])
    rotation = se2.rotation(turn)
    xyz[:, :2] = xyz[:, :2] @ rotation.T
    eyes = EYES.copy()
    eyes[:, :2] = np.array([[1.5, 1.5], [2.5, 1.8]]) @ rotation.T
    points = SeenPoints(xyz, seen(xyz).covariance, np.broadcast_to(eyes[0], xyz.shape))
    room = room_of(find_facades(points), points, eyes)
    found = np.array([wall.start for wall in room.walls]) @ rotation
    away = np.linalg.norm(found[:, None] - corners, axis=-1)
    assert len(found) == len(corners)
    assert away.min(0).max() < 0.03


@pytest.mark.parametrize(
    ('seed', 'count', 'low', 'high'),
    [
        (4, 150, (0.0, 0.0, 0.2), (6.0, 4.0, 2.2)),
        # Depth that is uncertain leaves a wide band, in which a blob has a line as well.
        (9, 90, (2.0, 1.9, 0.4), (3.2, 2.2, 1.6)),
    ],
)
def test_scattered_points_and_a_blob_make_no_facade(seed, count, low, high):
    xyz = np.random.default_rng(seed).uniform(low, high, (count, 3))
    assert find_facades(seen(xyz)) == []


@pytest.mark.parametrize('depth_m', [0.14, 0.3])
@pytest.mark.parametrize('seed', [11, 12, 13])
def test_a_wall_and_the_cupboard_beside_it_are_not_one_facade(seed, depth_m):
    rng = np.random.default_rng(seed)
    walls = on_walls(RECTANGLE, rng)[60:]
    stretch, front = (
        np.column_stack([rng.uniform(*x, 80), rng.normal(y, 0.01, 80), rng.uniform(0.4, 1.7, 80)])
        for x, y in (((0.7, 1.3), 0.0), ((4.6, 5.8), depth_m))
    )
    facades = find_facades(seen(np.vstack([stretch, walls, front])))
    along_x = [f for f in facades if f.normal[1] > 0.9]
    assert len(along_x) == 2
    for facade in along_x:
        ends = np.array([facade.start[1], facade.end[1]])
        assert np.abs(ends - depth_m).max() < 0.02 or np.abs(ends).max() < 0.02


def face(start, end, count, height, rng):
    """Points of what hangs or stands between two places."""
    xy = np.array(start) + rng.uniform(0, 1, (count, 1)) * np.subtract(end, start)
    return np.column_stack([xy + rng.normal(0, 0.01, (count, 2)), rng.uniform(*height, count)])


@pytest.mark.parametrize('seed', [21, 22, 23])
@pytest.mark.parametrize(
    'things',
    [
        # The front of a cupboard beside a picture, at the same wall.
        [((3.4, 0.0), (5.4, 0.0), 80), ((1.7, 0.5), (2.7, 0.5), 90), ((0.3, 0.0), (0.9, 0.0), 4)],
        # As much of a cupboard as of the wall: the line through both is neither.
        [
            ((4.0, 0.0), (5.6, 0.0), 40),
            ((1.5, 0.35), (1.9, 0.35), 12),
            ((2.0, 0.0), (2.5, 0.0), 12),
        ],
        # A frame, and pictures on either side of a stretch without anything.
        [
            ((0.4, 0.04), (1.0, 0.04), 30),
            ((1.1, 0.0), (1.6, 0.0), 30),
            ((4.4, 0.0), (5.2, 0.0), 30),
        ],
        # Few points on all of a wall.
        [((0.5, 0.0), (5.5, 0.0), 10)],
    ],
    ids=['cupboard', 'edge', 'frame', 'few'],
)
def test_a_wall_is_found_with_what_stands_and_hangs_before_it(things, seed):
    rng = np.random.default_rng(seed)
    parts = [face(start, end, count, (1.0, 1.7), rng) for start, end, count in things]
    points = seen(np.vstack([on_walls(RECTANGLE, rng)[60:], *parts]))
    room = room_of(find_facades(points), points, EYES)
    found = np.array([wall.start for wall in room.walls])
    assert len(found) == len(RECTANGLE)
    assert np.linalg.norm(found[:, None] - RECTANGLE, axis=-1).min(0).max() < 0.04


def test_too_few_walls_are_no_room():
    rng = np.random.default_rng(7)
    one = on_walls(RECTANGLE[:2], rng)[:60]
    facades = find_facades(seen(one))
    with pytest.raises(LandmarkNavError, match='make no'):
        room_of(facades, seen(one), EYES)


@pytest.mark.parametrize('count', [0, 1, 200])
def test_without_facades_a_room_goes_around_what_is_seen(count):
    rng = np.random.default_rng(8)
    xyz = np.column_stack([rng.uniform(-2, 8, (count, 2)), rng.uniform(0.2, 2.2, count)])
    room = open_room(seen(xyz), EYES)
    assert room.contains(EYES[:, :2]).all()
    around = EYES[:, :2] + np.array([[0.5, 0.0], [-0.5, 0.0]])[:, None]
    assert room.contains(around).all()
    assert count == 0 or np.mean(room.contains(xyz[:, :2])) > 0.8
    assert all(wall.sigma_m for wall in room.walls)


def test_two_posters_on_walls_that_meet_make_no_facade_across_the_corner():
    """Any two small groups of points have a line in common."""
    rng = np.random.default_rng(8)
    height = rng.uniform(0.8, 1.8, 40)
    one = np.column_stack([rng.uniform(5.2, 5.35, 40), np.zeros(40), height])
    other = np.column_stack([np.full(40, 6.0), rng.uniform(0.65, 0.8, 40), height])
    xyz = np.vstack([one, other])
    xyz[:, :2] += rng.normal(0, 0.01, (80, 2))
    facades = find_facades(seen(xyz, 0.03))
    across = np.array([0.7, 0.6]) / np.hypot(0.7, 0.6)
    assert not any(abs(facade.along @ across) > 0.9 for facade in facades)
