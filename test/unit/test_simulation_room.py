from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
import json

import cv2
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Paper, Room, Wall
from landmark_nav.simulation.furnishing import generate_scene, hang_tags, move_one_box
from landmark_nav.simulation.scene import Box, choose_sweep_places, EYE_HEIGHT_M, Lamp, Scene
from landmark_nav.simulation.setup_documents import (
    as_measured,
    robot_document,
    room_document,
    scene_document,
    start_document,
)
from landmark_nav.simulation.solids import back_to_front
from landmark_nav.simulation.surfaces import irradiance, light_of, Pyramid, values_of
from landmark_nav.simulation.wall_items import draw_item
from landmark_nav.simulation.world import Person
from landmark_nav.storage.setup_files import load_robot, load_room

SEEDS = range(30)
MOUNT = PanTiltMount((0.08, 0.0, 1.1), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.fixture(scope='module')
def scenes() -> list[Scene]:
    return [generate_scene(seed) for seed in SEEDS]


class TestRooms:
    def test_rooms_differ_by_their_seed_alone(self, scenes):
        assert generate_scene(5) == scenes[5]
        assert len({str(scene.room) for scene in scenes}) == len(scenes)
        images = [item.seed for scene in scenes for item in scene.items]
        assert len(set(images)) > 0.99 * len(images)

    def test_some_are_l_shaped_and_papers_hang_wide_apart(self, scenes):
        assert {4, 6} == {len(scene.room.walls) for scene in scenes}
        for scene in scenes:
            width, length = sorted(np.subtract(*scene.room.bounds[::-1]))
            assert 5.0 <= length <= 9.0
            assert 4.0 <= width <= 6.0
            papers = np.array([paper.center for paper in scene.room.papers])
            assert {paper.color for paper in scene.room.papers} == {'red', 'green', 'blue'}
            steps = np.linalg.norm(papers[:, None] - papers, axis=-1)[np.triu_indices(3, 1)]
            assert steps.min() > 1.0

    def test_nothing_overlaps_on_a_wall(self, scenes):
        for scene in scenes:
            for index, wall in enumerate(scene.room.walls):
                things = [
                    (item.along_m - item.width_m / 2, item.along_m + item.width_m / 2)
                    for item in scene.items
                    if item.wall == index
                ]
                for paper in scene.room.papers:
                    if scene.room.nearest_wall(paper.center[:2]) == index:
                        at = np.linalg.norm(np.array(paper.center[:2]) - wall.start)
                        things.append((at - paper.width / 2, at + paper.width / 2))
                things.sort()
                assert things[0][0] > 0.0
                assert things[-1][1] < wall.length
                assert all(a[1] < b[0] for a, b in pairwise(things))

    def test_every_room_shows_papers_and_target_to_two_places(self, scenes):
        for scene in scenes:
            places = choose_sweep_places(scene)
            assert places is not None
            assert places.shared_items >= 8
            a, b = places.poses[:, :2]
            assert 1.5 <= np.linalg.norm(a - b) <= 2.5
            marks = [paper.center[:2] for paper in scene.room.papers]
            marks.append(scene.target.center(scene.room)[:2])
            for place in (a, b):
                assert scene.room.contains(place)
                assert scene.distance_to_obstacles(place) > 0.4
                eyes = np.tile(place, (len(marks), 1))
                assert scene.sees(eyes, np.array(marks), EYE_HEIGHT_M).all()

    def test_given_walls_are_kept(self, scenes):
        room = scenes[3].room
        assert generate_scene(99, room).room == room
        assert generate_scene(99, room).items != scenes[3].items

    def test_refuses_a_room_without_space(self):
        small = closed_room([(0.0, 0.0), (1.2, 0.0), (1.2, 1.2), (0.0, 1.2)])
        paper = Paper('red', (0.5, 0.0, 1.5), 0.2, 0.3)
        with pytest.raises(LandmarkNavError, match='no two places'):
            generate_scene(0, replace(small, papers=(paper,)))

    def test_one_box_moves(self, scenes):
        scene = next(scene for scene in scenes if len(scene.boxes) > 2)
        boxes = move_one_box(scene, np.random.default_rng(0))
        assert len(boxes) == len(scene.boxes)
        assert len(set(boxes) - set(scene.boxes)) == 1


class TestScene:
    room = generate_scene(4).room

    @pytest.mark.parametrize(('height', 'seen'), [(0.8, True), (1.8, False)])
    def test_tall_furniture_hides_and_low_does_not(self, height, seen):
        scene = Scene(0, self.room, boxes=(Box((3.0, 2.0), 0.4, (0.5, 0.5, height), 'wood', 0),))
        assert scene.sees([3.0, 4.0], [3.0, 0.0], EYE_HEIGHT_M) == seen
        assert scene.sees([5.0, 4.0], [5.0, 0.0], EYE_HEIGHT_M)

    def test_clearance_is_the_distance_to_the_nearest_thing(self):
        box = Box((3.0, 2.0), 0.0, (0.6, 0.4, 0.5), 'wood', 0)
        scene = Scene(0, self.room, boxes=(box,))
        places = [[3.0, 2.7], [3.8, 2.0], [3.0, 2.0], [0.25, 2.0]]
        assert scene.distance_to_obstacles(places) == pytest.approx([0.5, 0.5, 0.0, 0.25])


class TestPainterOrder:
    @settings(max_examples=40)
    @given(st.integers(0, 10_000))
    def test_nothing_near_is_painted_before_what_it_covers(self, seed):
        rng = np.random.default_rng(seed)
        boxes = []
        for center in rng.uniform(-4.0, 4.0, (60, 2)):
            box = Box(
                (center[0], center[1]), rng.uniform(0, 3), (*rng.uniform(0.2, 1.2, 2), 1), '', 0
            )
            gap = [np.linalg.norm(center - b.center_xy) for b in boxes]
            if np.linalg.norm(center) > 1.2 and (not gap or min(gap) > 1.75):
                boxes.append(box)
        heading = rng.uniform(-np.pi, np.pi)
        ahead = [
            k
            for k, box in enumerate(boxes)
            if np.cos(np.arctan2(*box.center_xy[::-1]) - heading) > 0.4
        ]
        order = back_to_front([boxes[k].footprint for k in ahead], np.zeros(2), heading)
        rank = {ahead[k]: n for n, k in enumerate(order)}
        for angle in heading + np.linspace(-1.0, 1.0, 60):
            ray = np.array([np.cos(angle), np.sin(angle)])
            hits = []
            for k in ahead:
                start = boxes[k].footprint
                side = np.roll(start, -1, axis=0) - start
                det = ray[0] * side[:, 1] - ray[1] * side[:, 0]
                t = (start[:, 0] * side[:, 1] - start[:, 1] * side[:, 0]) / det
                s = (start[:, 0] * ray[1] - start[:, 1] * ray[0]) / det
                good = (t > 0) & (s >= 0) & (s <= 1)
                if good.any():
                    hits.append((t[good].min(), rank[k]))
            ranks = [r for _, r in sorted(hits)]
            assert ranks == sorted(ranks, reverse=True)

    def test_a_person_is_painted_after_the_wall_behind(self):
        wall, person = np.array([[0.0, 0.0], [4.0, 0.0]]), np.array([[1.5, 1.0], [1.0, 1.0]])
        assert back_to_front([person, wall], np.array([1.2, 2.5]), -np.pi / 2) == [1, 0]


class TestPyramid:
    def test_levels_average_and_keep_their_place(self):
        # A ramp of light across and down: how much there is at a place says where that place is.
        v, u = np.mgrid[:130, :200]
        ramp = (300 * np.stack([u, v, 0 * u], -1)).astype(np.uint16)
        pyramid = Pyramid.build(values_of(ramp), 3, 4)
        atlas = light_of(pyramid.atlas) / 300.0
        for i in range(3):
            for j in range(4):
                for place in ((0.5, 0.5), (0.3, 0.71)):
                    x, y = np.array(place) * pyramid.scale[i, j] + pyramid.offset[i, j]
                    x0, y0 = int(x), int(y)
                    part = atlas[y0 : y0 + 2, x0 : x0 + 2, :2]
                    wx, wy = np.array([1 - x + x0, x - x0]), np.array([1 - y + y0, y - y0])
                    found = np.einsum('i,j,ijc->c', wy, wx, part)
                    expected = np.array(place) * [200, 130] - 0.5
                    assert found == pytest.approx(expected, abs=0.8)


class TestLightAndPosters:
    def test_light_falls_off(self):
        lamp = Lamp((0.0, 0.0, 2.5), (0.6, 0.6))
        near, far = irradiance([[0.0, 0, 0], [3.0, 0, 0]], [0.0, 0.0, 1.0], [lamp])
        assert (near > far).all()
        dark = irradiance([[0.0, 0, 0]], [0.0, 0.0, 1.0], [replace(lamp, power=0.0)])
        assert (dark < near).all()

    @pytest.mark.parametrize('kind', ['photo', 'poster', 'shelf', 'blinds', 'door', 'target'])
    def test_images_have_texture_and_come_out_of_their_seed(self, kind):
        first = draw_item(kind, 1, (160, 120))
        assert first.shape == (160, 120, 3)
        assert first.dtype == np.uint8
        assert first.std() > 12.0
        assert np.array_equal(first, draw_item(kind, 1, (160, 120)))
        assert (kind == 'target') == np.array_equal(first, draw_item(kind, 2, (160, 120)))

    def test_people_walk_where_there_is_space(self, scenes):
        scene = scenes[2]
        robot = choose_sweep_places(scene).poses[0, :2]
        people = [Person(scene, robot, child) for child in np.random.default_rng(0).spawn(3)]
        seen = []
        for _ in range(300):
            for person in people:
                person.step(0.1, robot)
            seen.append([person.solid(robot).footprint.mean(axis=0) for person in people])
        seen = np.array(seen)
        assert np.ptp(seen, axis=0).max(axis=-1).min() > 0.5
        assert scene.distance_to_obstacles(seen).min() > 0.1
        assert np.linalg.norm(seen - robot, axis=-1).min() > 0.6


def test_documents_are_read_back(tmp_path, scenes):
    scene = scenes[1]
    (tmp_path / 'room.yaml').write_text(room_document(scene.room))
    assert load_room(tmp_path / 'room.yaml') == scene.room
    mount = PanTiltMount(
        (0.1, 0.0, 1.2), (0.0, 0.01, 0.0), (0.03, 0.0, 0.0), pan_min_rad=-2.9, pan_rate_rad_s=0.5
    )
    (tmp_path / 'robot.yaml').write_text(robot_document(mount))
    assert load_robot(tmp_path / 'robot.yaml') == mount
    assert json.loads(start_document(np.array([1.0, 2.0, 0.5])))['pose'] == [1.0, 2.0, 0.5]
    items = json.loads(scene_document(scene))['items']
    assert [item['kind'] for item in items].count('target') == 1


def closed_room(corners) -> Room:
    ends = zip(corners, [*corners[1:], corners[0]], strict=True)
    return Room(tuple(Wall(str(k), a, b, 2.5) for k, (a, b) in enumerate(ends)), ())


@pytest.mark.parametrize(
    'room',
    [
        generate_scene(3).room,
        generate_scene(4).room,
        closed_room([(0.0, 0.0), (5.0, 0.0), (6.0, 2.0), (3.0, 4.0), (0.0, 3.0)]),
    ],
)
def test_a_measured_room_has_its_walls_a_few_millimetres_off_and_still_closed(room) -> None:
    rng = np.random.default_rng(0)
    offs, papers, heights = [], [], []
    for _ in range(40):
        measured, mount = as_measured(room, MOUNT, rng)
        starts = np.array([wall.start for wall in measured.walls])
        ends = np.array([wall.end for wall in measured.walls])
        np.testing.assert_allclose(np.roll(starts, -1, axis=0), ends, atol=1e-9)
        np.testing.assert_allclose(measured.normals, room.normals, atol=1e-9)
        off = starts - [wall.start for wall in room.walls]
        offs.append(np.sum(off * room.normals[:, :2], 1))
        pairs = zip(measured.papers, room.papers, strict=True)
        papers += [np.subtract(a.center, b.center) for a, b in pairs]
        heights.append(mount.axis_xyz[2] - MOUNT.axis_xyz[2])
    assert 0.004 < np.std(offs) < 0.006
    assert np.abs(np.corrcoef(np.array(offs).T) - np.eye(len(room.walls))).max() < 0.6
    if papers:
        assert 0.0008 < np.sqrt(np.mean(np.sum(np.square(papers), -1)) / 2.0) < 0.0012
    assert 0.0035 < np.std(heights) < 0.0065


@pytest.mark.parametrize('number', [0, 7, 300])
def test_a_tag_is_read_as_its_number(number):
    drawn = cv2.copyMakeBorder(draw_item('tag', number, (120, 120)), 40, 40, 40, 40, 0, None, 90)
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    _, found, _ = cv2.aruco.ArucoDetector(family).detectMarkers(drawn)
    assert found.ravel().tolist() == [number]


@pytest.mark.parametrize('seed', [12, 13])
def test_tags_hang_where_nothing_else_does(seed):
    scene = generate_scene(seed)
    items = hang_tags(scene, 1.0)
    tags = items[len(scene.items) :]
    assert items[: len(scene.items)] == scene.items
    assert [tag.seed for tag in tags] == list(range(len(tags)))
    assert len(tags) > 5
    for tag in tags:
        for other in items:
            if other is not tag and other.wall == tag.wall:
                apart = abs(tag.along_m - other.along_m), abs(tag.center_z_m - other.center_z_m)
                sizes = tag.width_m + other.width_m, tag.height_m + other.height_m
                assert any(a >= 0.5 * s for a, s in zip(apart, sizes, strict=True))
        for paper in scene.room.papers:
            assert np.linalg.norm(tag.center(scene.room) - paper.center) > 0.5 * tag.width_m
