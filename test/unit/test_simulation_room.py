from dataclasses import replace

from builders import walls_of
import cv2
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.se2 import rotation_rpy
from landmark_nav.geometry.walls import Paper, Room
from landmark_nav.simulation.furnishing import generate_scene, move_one_box
from landmark_nav.simulation.renderer import Renderer
from landmark_nav.simulation.scene import Box, choose_sweep_places, EYE_HEIGHT_M, Scene, WallItem
from landmark_nav.simulation.setup_documents import as_measured

SEEDS = range(30)
MOUNT = PanTiltMount((0.08, 0.0, 1.1), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.fixture(scope='module')
def scenes():
    return [generate_scene(seed) for seed in SEEDS]


class TestRooms:
    def test_rooms_differ_by_their_seed_alone(self, scenes):
        assert generate_scene(5) == scenes[5]
        assert len({str(scene.room) for scene in scenes}) == len(scenes)
        images = [item.seed for scene in scenes for item in scene.items]
        assert len(set(images)) > 0.99 * len(images)

    def test_every_room_shows_papers_and_target_to_two_places(self, scenes):
        for scene in scenes:
            places = choose_sweep_places(scene)
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


def closed_room(corners):
    return Room(walls_of(corners), ())


@pytest.mark.parametrize(
    'room',
    [
        generate_scene(3).room,
        generate_scene(4).room,
        closed_room([(0.0, 0.0), (5.0, 0.0), (6.0, 2.0), (3.0, 4.0), (0.0, 3.0)]),
    ],
)
def test_a_measured_room_has_its_walls_a_few_millimetres_off_and_still_closed(room):
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


CAMERA = CameraModel(
    512, 512, 555.0, 555.0, 256.7, 254.1, 'plumb_bob', (-0.19, 0.06, 0.0005, -0.0003, 0.0)
)
OFF_CENTRE = PanTiltMount((0.08, 0.0, 1.1), (0.0, 0.0, 0.0), (0.03, 0.02, 0.01))
ROOM = Room(
    walls_of([(0, 0), (6.03, 0), (6.03, 4.4), (0, 4.4)], height=2.6),
    (Paper('blue', (3.8013, 0.02, 1.7507), 0.3, 0.3),),
)
TARGETS = tuple(
    WallItem('target', 0, along, z, 0.5, 0.5, 0, before)
    for along, z, before in (
        (0.61, 1.5507, 0.0),
        (1.5093, 1.7, 0.03),
        (2.7031, 1.45, 0.0),
        (4.9, 1.6, 0.02),
    )
)
SCENE = Scene(3, ROOM, TARGETS, (Box((1.2, 1.0), 0.3, (0.5, 0.4, 0.7), 'books', 5),))


@pytest.fixture(scope='module')
def renderer():
    return Renderer(SCENE, CAMERA)


def camera_pose(pose, pan, tilt=0.0):
    rotation, center = OFF_CENTRE.camera_pose_base(pan, tilt)
    heading = rotation_rpy((0.0, 0.0, pose[2]))
    return heading @ rotation, heading @ center + [pose[0], pose[1], 0.0]


def project(points_map, rotation, center):
    return CAMERA.project((np.asarray(points_map) - center) @ rotation)


def target_reference(item, rotation, center, window):
    """Brightness of a target by ray casting alone, 4 x 4 rays a pixel, and where it is."""
    u0, u1, v0, v1 = window
    sub = (np.arange(4) + 0.5) / 4 - 0.5
    u = (np.arange(u0, u1)[:, None] + sub).ravel()
    v = (np.arange(v0, v1)[:, None] + sub).ravel()
    rays = CAMERA.unproject(np.stack(np.meshgrid(u, v), -1)) @ rotation.T
    hit = center + rays * ((item.before_m - center[1]) / rays[..., 1])[..., None]
    radius = np.hypot(hit[..., 0] - item.along_m, hit[..., 2] - item.center_z_m) / item.width_m
    bright = np.where((radius < 0.49) & ((radius / 0.14) % 1.0 < 0.5), 0.0, 1.0)
    shape = (v1 - v0, 4, u1 - u0, 4)
    return bright.reshape(shape).mean(axis=(1, 3)), radius.reshape(shape).max(axis=(1, 3)) < 0.46


def shift_between(image, reference, where):
    """Sub-pixel shift (x, y) of `image` from `reference`, with gain and offset free."""
    blurred = [cv2.GaussianBlur(k.astype(np.float64), (5, 5), 1.0) for k in (image, reference)]
    dy, dx = np.gradient(blurred[1])
    a = np.stack([-dx, -dy, blurred[1], np.ones_like(dx)], -1)[where]
    fit = np.linalg.lstsq(a, blurred[0][where], rcond=None)[0]
    return np.asarray(fit[:2] / fit[2])


# Near, far (other levels of detail), slanted; pan puts the targets all over the image.
@pytest.mark.parametrize(
    ('pose', 'pans', 'tilts'),
    [
        ((2.2, 1.4, 0.3), (-1.6, -1.2), (0.1,)),
        ((2.9, 4.1, -1.0), (-0.9, -0.4), (-0.1, 0.2)),
        ((5.3, 1.5, 2.0), (1.3,), (0.0, 0.15)),
    ],
)
def test_walls_appear_where_the_camera_model_projects_them(renderer, pose, pans, tilts):
    errors = []
    for pan in pans:
        for tilt in tilts:
            rotation, center = camera_pose(pose, pan, tilt)
            image = cv2.cvtColor(renderer.render(rotation, center), cv2.COLOR_BGR2GRAY)
            for item in TARGETS:
                corners = item.center(ROOM) + 0.25 * np.array(
                    [[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]]
                )
                uv = project(corners, rotation, center)
                if not np.all(CAMERA.contains(uv, 2.0)):
                    continue
                low = np.ceil(uv.min(axis=0)).astype(int)
                high = np.floor(uv.max(axis=0)).astype(int)
                window = (low[0], high[0], low[1], high[1])
                reference, on_target = target_reference(item, rotation, center, window)
                part = image[low[1] : high[1], low[0] : high[0]]
                errors.append(shift_between(part, reference, on_target))
    errors = np.array(errors)
    assert len(errors) >= 2
    assert np.abs(errors).max() < 0.03
    assert np.abs(errors.mean(axis=0)).max() < 0.015


def test_nearer_things_cover_farther_ones(renderer):
    # The box stands between the camera and the south wall; its top is lower than the camera.
    rotation, center = camera_pose((1.2, 3.6, -np.pi / 2), 0.0, -0.2)
    box = SCENE.boxes[0]
    with_box = renderer.render(rotation, center)
    without = Renderer(Scene(3, ROOM, TARGETS), CAMERA).render(rotation, center)
    changed = np.any(with_box != without, axis=-1)
    corners = np.array(
        [[*xy, z] for xy in box.footprint for z in (0.0, box.size_m[2])], dtype=np.float64
    )
    # The lens bends edges outward: points along them. Seams reach a little over corners.
    share = np.linspace(0.0, 1.0, 30)[:, None, None, None]
    edges = (share * corners[:, None] + (1.0 - share) * corners).reshape(-1, 3)
    hull = cv2.convexHull(project(edges, rotation, center).astype(np.float32))
    inside = np.zeros(changed.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.rint(hull).astype(np.int32), 1)
    assert changed[cv2.dilate(inside, np.ones((7, 7))) == 0].sum() == 0
    assert changed[cv2.erode(inside, np.ones((7, 7))) == 1].mean() > 0.95
