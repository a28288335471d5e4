"""Upright edges as landmarks: they are certain across, which is what a bearing needs."""

from __future__ import annotations

from east_wall import HERE, LENS, MOUNT, PRIOR
import numpy as np
import pytest
from scenes import (
    Board,
    draw_frame,
    draw_panorama,
    flat_texture,
    rectangle_room,
    Scene,
    wall_board,
)

from landmark_nav.calibration import Calibration
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.patches import is_upright_edge
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningConfig
from landmark_nav.localization.detection import detect_landmarks, DetectionConfig, View
from landmark_nav.localization.localizer import LocalizationConfig, Localizer
from landmark_nav.localization.relocalization import Relocalizer
from landmark_nav.matching import Match, match_template
from landmark_nav.types import PoseEstimate, Refusal

ROOM = rectangle_room(6.0, 5.0)
# Doors from floor to ceiling: wall, middle along it (m), width (m).
DOORS = [
    (0, 1.5, 0.8),
    (0, 4.0, 0.7),
    (1, 1.2, 0.9),
    (1, 3.6, 0.75),
    (2, 2.5, 0.85),
    (3, 2.0, 0.7),
]


def bare_room():
    walls = [
        wall_board(wall, flat_texture((g, g, g)))
        for wall, g in zip(ROOM.walls, (150, 165, 140, 155), strict=True)
    ]
    doors = []
    for k, (index, along_m, width_m) in enumerate(DOORS):
        wall = ROOM.walls[index]
        center = np.array([*(np.array(wall.start) + along_m * wall.along), wall.height / 2.0])
        grey = 60.0 + 12.0 * k
        color = flat_texture((grey, grey, grey))
        place = center + 1e-4 * wall.normal
        doors.append(Board(place, wall.normal, width_m, wall.height, color))
    return Scene((*walls, *doors))


def edges_xy():
    """Edges of all doors in plan, (n, 2)."""
    ends = []
    for index, along_m, width_m in DOORS:
        wall = ROOM.walls[index]
        ends += [np.array(wall.start) + (along_m + s * width_m / 2) * wall.along for s in (-1, 1)]
    corners = [wall.start for wall in ROOM.walls]
    return np.array([*ends, *corners])


@pytest.fixture(scope='module')
def learned():
    rng = np.random.default_rng(1)
    scene = bare_room()
    places = [((2.2, 2.0, 1.1), 0.4), ((3.6, 2.9, 1.1), -2.0)]
    panoramas = [draw_panorama(scene, np.array(c), h, rng=rng) for c, h in places]
    return learn_from_panoramas(panoramas, ROOM, LearningConfig()).map


def test_a_room_with_nothing_but_edges_is_learned(learned):
    assert all(landmark.edge for landmark in learned.landmarks)
    assert not learned.distinct.landmarks
    off = learned.positions[:, None, :2] - edges_xy()
    edge = np.argmin(np.hypot(*np.moveaxis(off, 2, 0)), axis=1)
    nearest = off[range(len(off)), edge]
    # Parts of one edge share their error: it is one landmark.
    assert len(set(edge)) == len(edge) > 8
    assert np.hypot(*nearest.T).max() < 0.2
    # A patch is centred near its edge only, but it is on the wall.
    assert np.abs(np.sum(nearest * learned.normals[:, :2], axis=1)).max() < 0.02


def test_bearings_of_edges_are_as_good_as_stated(learned):
    scene, squares = bare_room(), []
    for seed, pan in enumerate((0.05, 0.5, 0.9, -0.4, -0.8, 1.6, 2.2, -2.2)):
        frame = draw_frame(scene, LENS, MOUNT, HERE, pan, rng=np.random.default_rng(seed))
        prior = PoseEstimate(frame.stamp_ns, HERE + np.array([0.01, -0.01, 0.004]), PRIOR)
        every = np.arange(len(learned.landmarks))
        view = View(frame, prior, MOUNT)
        found = detect_landmarks(view, learned, DetectionConfig(), every).detections
        axis = MOUNT.axis_pose_map(HERE)
        away = learned.positions[learned.indices(found.ids), :2]
        off = wrap_rad(found.bearing_rad - se2.bearings(axis, away))
        assert np.abs(off).max(initial=0.0) < 2e-3
        index = learned.indices(found.ids)
        ray = away - axis[:2]
        across = np.stack([-ray[:, 1], ray[:, 0]], 1) / np.sum(ray**2, 1)[:, None]
        own = np.einsum('ni,nij,nj->n', across, learned.covariances[index, :2, :2], across)
        squares += (off**2 / (found.variance_rad2 + own)).tolist()
        assert found.covariance_px2 is not None
        assert (found.covariance_px2[:, 1, 1] > 10.0 * found.covariance_px2[:, 0, 0]).all()
    assert len(squares) > 10
    assert np.mean(squares) < 2.0


def test_edges_alone_find_no_place_but_keep_one(learned):
    frame = draw_frame(bare_room(), LENS, MOUNT, HERE, 0.05, rng=np.random.default_rng(7))
    assert isinstance(Relocalizer(learned, MOUNT).add_frame(frame), Refusal)
    given = HERE + np.array([0.01, -0.01, 0.004])
    for covariance, used in ((PRIOR, True), (np.diag([0.5, 0.5, 0.3]) ** 2, False)):
        localizer = Localizer(learned, Calibration.of_mount(MOUNT), LocalizationConfig())
        localizer.initialize(PoseEstimate(frame.stamp_ns, given, covariance))
        update = localizer.add_frame(frame)
        # Where the window is wide, another edge may be in it.
        assert bool(len(update.observation.detections)) is used


@pytest.mark.parametrize('slope', [0.0, 0.07, -0.07])
def test_matches_of_an_edge_err_across_as_their_covariance_states(slope):
    down, across = np.mgrid[:46, :60].astype(np.float64)

    def image(at):
        distance = across - at - slope * (down - 22.5)
        step = 90.0 + 70.0 / (1.0 + np.exp(-2.0 * distance))
        return step + 25.0 * np.exp(-0.5 * ((distance - 5.0) / 1.5) ** 2)

    squares = []
    for seed in range(200):
        rng = np.random.default_rng([seed, 5])
        shift = rng.uniform(-1.5, 1.5)
        template = image(29.5)[8:38, 15:45].astype(np.float32)
        search = (image(29.5 + shift) + 15.0 * rng.standard_normal(down.shape)).astype(np.float32)
        found = match_template(search, template, edge=True)
        assert isinstance(found, Match)
        # Any point of the edge is as good as any other.
        off = found.xy[0] - 29.5 - shift - slope * (found.xy[1] - 22.5)
        squares.append(off**2 / ([1.0, -slope] @ found.covariance @ [1.0, -slope]))
        assert found.covariance[1, 1] > 10.0
    assert 0.7 < np.mean(squares) < 1.4


def test_only_upright_edges_are_edges():
    down, across = np.mgrid[:30, :30]
    for slope, upright in ((0.0, True), (0.05, True), (0.3, False), (10.0, False)):
        step = np.where(across - 14.5 - slope * (down - 14.5) < 0, 60, 200).astype(np.uint8)
        assert is_upright_edge(step) is upright
        assert not is_upright_edge(np.where(down < 15, 60, step).astype(np.uint8))
    for size in ((30, 30), (1, 30), (30, 1), (0, 0)):  # landmarks of other sources have no patch
        assert not is_upright_edge(np.full(size, 128, np.uint8))
