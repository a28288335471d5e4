"""Landmarks in images: bearings, refusals, and rows that tell wrong heights from tilts."""

from dataclasses import replace

from east_wall import (
    CONFIG,
    detect,
    EAST,
    errors_of,
    HERE,
    LANDMARKS,
    LENS,
    map_of,
    MOUNT,
    PLACES,
    PRIOR,
    ROOM,
    SCENE,
)
import numpy as np
import pytest
from scenes import (
    Board,
    draw_frame,
    draw_panorama,
    flat_texture,
    rectangle_room,
    Scene,
    textured_room,
    true_landmark,
    wall_board,
)

from landmark_nav.calibration import Calibration
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.geometry.patches import PatchView
from landmark_nav.geometry.se2 import rot_z
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningConfig
from landmark_nav.localization.detection.correlation import detect_landmarks
from landmark_nav.localization.detection.expectation import DetectionConfig, expect, View
from landmark_nav.localization.detection.rows import RowModel, RowResiduals, wrong_heights
from landmark_nav.localization.localizer import LocalizationConfig, Localizer
from landmark_nav.localization.relocalization.stream import Relocalizer
from landmark_nav.localization.relocalization.verification import estimate_camera_tilt
from landmark_nav.types import PoseEstimate, Refusal


def test_bearings_err_as_their_variances_say():
    rng = np.random.default_rng(1)
    squares, counts = [], []
    for _ in range(25):
        pose = HERE + rng.uniform((-0.4, -0.4, -0.1), (0.4, 0.4, 0.1))
        frame = draw_frame(SCENE, LENS, MOUNT, pose, rng=rng, sigma=6.0)
        prior = pose + rng.multivariate_normal(np.zeros(3), PRIOR)
        result = detect(frame, prior)
        squares += list(errors_of(result, pose) ** 2 / result.detections.variance_rad2)
        counts.append(len(result.detections))
    assert np.mean(counts) > 3.0
    assert 0.3 < np.mean(squares) < 1.6
    assert np.max(squares) < 16.0


@pytest.mark.parametrize('shift', [(0.05, 0.0, 0.0), (0.0, -0.05, 0.0), (0.0, 0.0, 0.02)], ids=str)
def test_a_prior_that_is_off_does_not_move_the_bearings(shift):
    frame = draw_frame(SCENE, LENS, MOUNT, HERE)
    result = detect(frame, HERE + np.array(shift))
    assert len(result.detections) == 4
    assert np.abs(errors_of(result, HERE)).max() < 5e-4


@pytest.mark.parametrize('away_m', [1.6, 2.4, 4.5])
def test_patches_are_found_at_half_and_twice_the_distance(away_m):
    # Learned from 3 m.
    pose = np.array([6.0 - away_m - MOUNT.axis_xyz[0], 2.4, 0.0])
    frame = draw_frame(SCENE, LENS, MOUNT, pose, rng=np.random.default_rng(2))
    landmarks = map_of([(-0.15, 0.1), (0.2, -0.1)])
    result = detect(frame, pose, landmarks)
    assert len(result.detections) == 2
    assert np.abs(errors_of(result, pose, landmarks)).max() < 1.5e-3


def seen_from_elsewhere(landmark_map, view):
    """Map whose patches are of something else, and whose only other view is right."""
    other = textured_room(ROOM, seed=7, feature_m=0.04)
    wrong = [
        true_landmark(other, k.id, other.boards[1], *place, k.viewpoint).patch
        for k, place in zip(landmark_map.landmarks, PLACES, strict=True)
    ]
    return replace(
        landmark_map,
        landmarks=tuple(
            replace(k, patch=patch, views=(PatchView(view, k.patch),))
            for k, patch in zip(landmark_map.landmarks, wrong, strict=True)
        ),
    )


def test_a_virtual_view_shows_what_the_nearest_panorama_saw():
    # Things look otherwise from the other side, as what stands out or shines does.
    beside = np.array([3.0, 2.3, 1.15])
    landmarks = seen_from_elsewhere(map_of(PLACES, viewpoint=np.array([4.8, -1.5, 1.15])), beside)
    frame = draw_frame(SCENE, LENS, MOUNT, HERE)
    virtual = detect(frame, HERE, landmarks)
    assert sorted(virtual.detections.ids) == [1, 2, 3, 4]
    assert np.abs(errors_of(virtual, HERE, landmarks)).max() < 2e-4
    alone = replace(landmarks, landmarks=tuple(replace(k, views=()) for k in landmarks.landmarks))
    assert len(detect(frame, HERE, alone).detections) == 0


def test_a_covered_landmark_is_refused():
    person = Board(
        np.array([5.0, 2.3, 1.0]), EAST.normal, 0.5, 1.6, flat_texture((60.0, 60.0, 60.0))
    )
    crowded = Scene((*SCENE.boards, person))
    result = detect(draw_frame(crowded, LENS, MOUNT, HERE), HERE)
    # The person stands before the second and the third.
    assert sorted(result.detections.ids) == [1, 4]
    assert sorted(result.refused) == [2, 3]
    assert np.abs(errors_of(result, HERE)).max() < 2e-4


def test_an_image_that_was_rehung_higher_is_refused():
    # By 2 cm, which is 3 pixels from here: inside the window, but not where the others have it.
    frame = draw_frame(SCENE, LENS, MOUNT, HERE)
    moved = LANDMARKS.landmarks[1]
    moved = replace(moved, position=moved.position - [0.0, 0.0, 0.02])
    result = detect(frame, HERE, replace(LANDMARKS, landmarks=(
        LANDMARKS.landmarks[0], moved, *LANDMARKS.landmarks[2:]
    )))  # fmt: skip
    assert sorted(result.detections.ids) == [1, 3, 4]
    assert result.refused[2].reason == 'wrong height'
    # Expected lower than it is: in the image it is above, by a negative number of rows.
    assert -4.0 < float(result.refused[2].detail.split()[0]) < -2.0


@pytest.mark.parametrize('over', [{'tilt_rad': 0.006}, {'roll_rad': 0.006}], ids=str)
def test_a_floor_that_is_tilted_moves_all_heights_and_refuses_none(over):
    # By 2.4 pixels in the middle, or at one focal length aside.
    tilted = replace(MOUNT, camera_roll_rad=over.get('roll_rad', 0.0))
    frame = draw_frame(SCENE, LENS, tilted, HERE)
    frame = replace(frame, tilt_rad=over.get('tilt_rad', 0.0))
    assert len(detect(frame, HERE).detections) == 4


@pytest.mark.parametrize('hung_rad', [0.0, np.pi / 2, np.pi])
def test_landmarks_are_expected_where_a_rolling_shutter_shows_them(hung_rad):
    """Also where the camera is mounted on its side, or upside down."""
    turn_rad, every = 0.1, np.arange(4)
    still = replace(draw_frame(SCENE, LENS, MOUNT, HERE), roll_rad=hung_rad)

    def expected(**changed):
        view = View(replace(still, **changed), PoseEstimate(0, HERE, PRIOR), MOUNT)
        return np.array([place.uv for place in expect(LANDMARKS, every, view, CONFIG)])

    rolled = expected(row_turn_rad=turn_rad)
    for k, row_px in enumerate(rolled[:, 1]):
        later = expected(pan_rad=turn_rad * (row_px - LENS.cy) / LENS.fy)[k]
        assert rolled[k] == pytest.approx(later, abs=0.6)
    assert np.abs(rolled - expected()).max() > 3.0


PLAIN = CameraModel(512, 512, 555.0, 555.0, 256.0, 256.0, distortion=(-0.1, 0.02, 0.0, 0.0))
FISHEYE = CameraModel(512, 512, 250.0, 250.0, 256.0, 256.0, 'equidistant', (0.02, -0.01, 0.0, 0.0))
CENTRED = replace(MOUNT, optical_center_offset=(0.0, 0.0, 0.0))
POSE, PAN, TILT = np.array([1.0, 2.0, 0.3]), 0.4, 0.1


def model_of(camera, spread, mount=CENTRED):
    """Rows of eight points about 3 m away."""
    rotation, center = mount.camera_pose_map(POSE, PAN, TILT)
    offset = np.random.default_rng(0).uniform(-spread, spread, (8, 3))
    offset[:, 2] += 3.0
    points = center + offset @ rotation.T
    return RowModel.of(points, POSE, rotation, center, camera, mount.camera_roll_rad), points


@pytest.mark.parametrize(
    ('camera', 'spread', 'mounted_rad', 'hung_rad'),
    [
        (PLAIN, 0.8, 0.0, 0.0),
        (FISHEYE, 2.0, 0.0, 0.0),
        (PLAIN, 0.8, np.pi, 0.0),
        (PLAIN, 0.8, 0.5, 0.0),
        (PLAIN, 0.8, 0.0, np.pi),
    ],
)
def test_derivatives_are_those_of_the_camera(camera, spread, mounted_rad, hung_rad):
    """Also where camera or unit are mounted upside down, or aslant."""
    mount = replace(CENTRED, camera_roll_rad=mounted_rad, axis_rpy=(hung_rad, 0.0, 0.0))
    model, points = model_of(camera, spread, mount)

    def rows(pose, tilt_rad, roll_rad, higher_m):
        turn, _ = mount.camera_pose_base(PAN, tilt_rad, roll_rad)
        _, center = mount.camera_pose_map(pose, PAN, tilt_rad)
        raised = points + np.array([0.0, 0.0, higher_m])
        return camera.project((raised - center) @ (rot_z(pose[2]) @ turn))[:, 1]

    at = np.array([*POSE, TILT, 0.0, 0.0])
    by = [
        (rows(up[:3], *up[3:]) - rows(down[:3], *down[3:])) / 2e-5
        for up, down in ((at + s, at - s) for s in 1e-5 * np.eye(6))
    ]
    np.testing.assert_allclose(model.by_pose.T, by[:3], rtol=1e-3, atol=0.05)
    np.testing.assert_allclose(model.by_tilt_roll.T, by[3:5], rtol=1e-3, atol=0.05)
    np.testing.assert_allclose(model.by_height, by[5], rtol=1e-3, atol=0.05)


POSE_SIGMA = np.array([0.01, 0.01, 0.005])


def rows_of(model, own_px, sigma=POSE_SIGMA):
    """Covariance (8, 8) of rows, of points that are where they seem to be."""
    none = np.zeros((8, 3, 3))
    return model.covariance(np.diag(sigma**2), none, none) + own_px**2 * np.eye(8)


@pytest.mark.parametrize('camera', [PLAIN, FISHEYE])
def test_right_heights_are_refused_hardly_ever_and_wrong_ones_are(camera):
    model, _ = model_of(camera, 0.8)
    covariance = rows_of(model, 0.15) + 0.002**2 * model.by_tilt_roll @ model.by_tilt_roll.T
    rng = np.random.default_rng(2)
    # Of one row, given the others: a single near point distinguishes a height from a tilt.
    own_px = 1.0 / np.sqrt(np.diag(np.linalg.inv(covariance)))
    refused = 0
    for _ in range(300):
        off = rng.multivariate_normal(np.zeros(8), covariance)
        refused += int(wrong_heights(off, covariance).sum())
        k = int(rng.integers(8))
        off[k] += 12.0 * own_px[k]
        wrong = wrong_heights(off, covariance)
        assert wrong[k]
        assert wrong.sum() <= 2
    assert refused <= 3


@pytest.mark.parametrize('camera', [PLAIN, FISHEYE])
def test_a_tilt_is_recognised_by_all_rows_together_and_not_by_any_single_one(camera):
    model, points = model_of(camera, 0.8)
    runs, tilted = 200, np.array([0.01, -0.03])
    covariance = rows_of(model, 0.3)
    rng = np.random.default_rng(4)

    def tilt_of(off):
        return estimate_camera_tilt(RowResiduals(off, model.by_tilt_roll, covariance, points))

    squares, level, mistaken, reported = [], 0, 0, 0
    for _ in range(runs):
        off = rng.multivariate_normal(np.zeros(8), covariance)
        level += tilt_of(off).sure
        camera_tilt = tilt_of(off + model.by_tilt_roll @ tilted)
        reported += camera_tilt.sure
        squares.append(((camera_tilt.roll_rad - tilted[1]) / camera_tilt.roll_sigma_rad) ** 2)
        off[int(rng.integers(8))] += 5.0 * rng.choice([-1.0, 1.0])
        mistaken += tilt_of(off).sure
    assert reported == runs
    assert level + mistaken <= 2
    assert 0.75 < np.mean(squares) < 1.3


def test_a_height_that_was_measured_wrongly_is_no_tilt():
    """What is near, on one side of the image, is shifted more than what is far on the other."""
    rotation, center = CENTRED.camera_pose_map(POSE, PAN, TILT)
    aside = np.linspace(-0.35, 0.35, 8)
    reach = np.linspace(1.2, 4.0, 8)
    points = center + np.stack([reach * aside, 0.1 * reach, reach], -1) @ rotation.T
    model = RowModel.of(points, POSE, rotation, center, PLAIN, 0.0)
    own = 0.2
    covariance = rows_of(model, own, np.array([0.003, 0.003, 0.002]))
    rng = np.random.default_rng(3)

    def is_roll(off):
        tilt = estimate_camera_tilt(RowResiduals(off, model.by_tilt_roll, covariance, points))
        return tilt.is_roll

    for lower_m in (-0.01, 0.01):
        for _ in range(20):
            off = lower_m * model.by_height + own * rng.normal(size=8)
            assert not is_roll(off)
            assert is_roll(off + model.by_tilt_roll @ [0.0, 0.035])


BARE_ROOM = rectangle_room(6.0, 5.0)
# Doors from floor to ceiling: wall, middle along it (m), width (m).
DOORS = [(0, 1.5, 0.8), (0, 4.0, 0.7), (1, 1.2, 0.9), (1, 3.6, 0.75), (2, 2.5, 0.85), (3, 2, 0.7)]


def bare_room():
    def grey(value):
        return flat_texture((value, value, value))

    boards = [
        wall_board(wall, grey(g))
        for wall, g in zip(BARE_ROOM.walls, (150, 165, 140, 155), strict=True)
    ]
    for k, (index, along_m, width_m) in enumerate(DOORS):
        wall = BARE_ROOM.walls[index]
        middle = np.array([*(wall.start + along_m * wall.along), wall.height / 2.0])
        place = middle + 1e-4 * wall.normal
        boards.append(Board(place, wall.normal, width_m, wall.height, grey(60.0 + 12.0 * k)))
    return Scene(tuple(boards))


def edges_xy():
    """Edges of all doors in plan, (n, 2)."""
    ends = []
    for index, along_m, width_m in DOORS:
        wall = BARE_ROOM.walls[index]
        ends += [np.array(wall.start) + (along_m + s * width_m / 2) * wall.along for s in (-1, 1)]
    corners = [wall.start for wall in BARE_ROOM.walls]
    return np.array([*ends, *corners])


@pytest.fixture(scope='module')
def learned():
    rng, scene = np.random.default_rng(1), bare_room()
    places = [((2.2, 2.0, 1.1), 0.4), ((3.6, 2.9, 1.1), -2.0)]
    panoramas = [draw_panorama(scene, np.array(c), h, rng=rng) for c, h in places]
    return learn_from_panoramas(panoramas, BARE_ROOM, LearningConfig()).map


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
