from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Room, Wall

# An L: 6 x 4 m without its upper right 3 x 2 m.
CORNERS = [(0.0, 0.0), (6.0, 0.0), (6.0, 2.0), (3.0, 2.0), (3.0, 4.0), (0.0, 4.0)]


def outline(corners: list[tuple[float, float]]) -> tuple[Wall, ...]:
    ends = corners[1:] + corners[:1]
    return tuple(
        Wall(str(k), start, end, 2.5)
        for k, (start, end) in enumerate(zip(corners, ends, strict=True))
    )


ROOM = Room(outline(CORNERS))
INSIDE = st.tuples(st.floats(0.01, 2.99), st.floats(0.01, 3.99)) | st.tuples(
    st.floats(0.01, 5.99), st.floats(0.01, 1.99)
)


def test_normals_point_into_the_room() -> None:
    np.testing.assert_allclose(ROOM.normals[:3], [[0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    assert ROOM.walls[0].length == 6.0


@given(INSIDE, st.floats(-7.0, 7.0))
def test_a_ray_from_inside_ends_on_the_wall_that_it_names(
    origin: tuple[float, float], azimuth: float
) -> None:
    distance, wall = ROOM.raycast(origin, azimuth)
    direction = np.array([np.cos(azimuth), np.sin(azimuth)])
    hit = np.array(origin) + distance * direction
    start, normal = np.array(ROOM.walls[wall].start), ROOM.normals[wall, :2]
    assert abs((hit - start) @ normal) < 1e-6
    assert ROOM.contains(origin + 0.999 * distance * direction)


def test_the_first_of_several_walls_stops_the_ray() -> None:
    distance, wall = ROOM.raycast([1.0, 3.0], [0.0, np.pi / 2, np.pi, -np.pi / 4])
    np.testing.assert_allclose(distance, [2.0, 1.0, 1.0, 3.0 * np.sqrt(2.0)])
    assert wall.tolist() == [3, 4, 5, 0]


def test_a_ray_that_meets_nothing_reports_it() -> None:
    distance, wall = ROOM.raycast([7.0, 1.0], 0.0)
    assert np.isinf(distance)
    assert wall == -1


def test_one_origin_serves_many_rays_and_many_origins_one() -> None:
    assert ROOM.raycast([1.0, 1.0], np.zeros((2, 3)))[0].shape == (2, 3)
    distance, _ = ROOM.raycast([[1.0, 1.0], [2.0, 1.0]], [0.0, 0.0])
    np.testing.assert_allclose(distance, [5.0, 4.0])


def test_the_corner_hides_what_lies_behind() -> None:
    on_walls = [[3.0, 3.0], [6.0, 1.0], [1.0, 0.0], [6.0, 1.99]]
    assert ROOM.visible([1.0, 3.0], on_walls).tolist() == [True, False, True, False]
    assert ROOM.visible([5.0, 1.0], on_walls).tolist() == [False, True, True, True]


def test_contains_counts_the_notch_as_outside() -> None:
    points = [[1.0, 1.0], [5.0, 1.0], [5.0, 3.0], [-0.1, 1.0], [1.0, 3.9], [1.0, 4.1]]
    assert ROOM.contains(points).tolist() == [True, True, False, False, True, False]


def test_nearest_wall_measures_to_the_segment_not_its_line() -> None:
    # (5, 2.5) is 0.5 m above wall 2; the line of wall 1, x = 6, is 1 m away.
    assert ROOM.nearest_wall([[5.0, 2.5], [0.2, 2.0], [3.0, 0.1]]).tolist() == [2, 5, 0]


def test_a_room_shares_a_wall_with_itself_measured_again_and_none_with_another() -> None:
    again = outline([(1.03 * x, 0.97 * y) for x, y in CORNERS])
    assert ROOM.shares_wall(again, 0.3)
    assert ROOM.shares_wall([again[4]], 0.3)
    # Parallel walls from the same corner are not the same.
    assert not ROOM.shares_wall(outline([(0.0, 0.0), (5.0, 0.0), (5.0, 3.2), (0.0, 3.2)]), 0.3)
    assert not ROOM.shares_wall((), 0.3)


def test_two_walls_are_no_room() -> None:
    with pytest.raises(LandmarkNavError, match='room has 2 walls: a closed outline needs 3'):
        Room(outline(CORNERS)[:2])


def test_an_open_outline_names_the_wall_and_the_gap() -> None:
    corners = outline(CORNERS)
    moved = Wall('2', (6.0, 2.3), (3.0, 2.0), 2.5)
    with pytest.raises(LandmarkNavError, match=r'open: wall 1 ends at \(6, 2\).*0\.3 m away'):
        Room((*corners[:2], moved, *corners[3:]))


def test_crossing_walls_are_named() -> None:
    bow_tie = [(0.0, 0.0), (4.0, 3.0), (4.0, 0.0), (0.0, 3.0)]
    with pytest.raises(LandmarkNavError, match='walls 0 and 2 cross'):
        Room(outline(bow_tie))


def test_walls_that_run_clockwise_are_refused() -> None:
    with pytest.raises(LandmarkNavError, match=r'to the left.*swap start and end'):
        Room(outline(CORNERS[::-1]))


@pytest.mark.parametrize(
    ('wall', 'message'),
    [
        (Wall('0', (0.0, float('nan')), (6.0, 0.0), 2.5), 'wall 0 has a coordinate'),
        (Wall('0', (0.0, 0.0), (0.0, 0.0), 2.5), 'wall 0 has no length'),
        (Wall('0', (0.0, 0.0), (6.0, 0.0), 0.0), 'no length or no height'),
    ],
)
def test_a_wall_that_is_none_is_refused(wall: Wall, message: str) -> None:
    with pytest.raises(LandmarkNavError, match=message):
        Room((wall, *outline(CORNERS)[1:]))
