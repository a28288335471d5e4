from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scenes import (
    Board,
    draw_panorama,
    draw_sweep,
    flat_texture,
    GREY,
    paper_board,
    rectangle_room,
    Scene,
    textured_room,
    wall_board,
)
from scipy.special import chdtri

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.se2 import cross
from landmark_nav.geometry.walls import Paper
from landmark_nav.learning.pipeline import learn_from_panoramas, LearningConfig
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.sweep_pipeline import next_prior, panorama_from_sweep
from landmark_nav.learning.unmeasured import locate_sweeps, UnmeasuredConfig
from landmark_nav.types import PlaceChain, PoseEstimate, Refusal, Sweep

CAMERA = CameraModel(
    300, 220, 250.0, 250.0, 150.0, 110.0, distortion=(-0.18, 0.05, 0.001, -0.001, 0.0)
)
MOUNT = PanTiltMount(axis_xyz=(0.1, -0.02, 1.15))
POSES = (np.array([1.8, 1.7, 0.5]), np.array([3.0, 2.5, -1.9]))
TURN = np.radians(np.arange(0.0, 360.0, 20.0))
PAPERS = (
    Paper('red', (5.0, 1.2, 1.25), 0.21, 0.297),
    Paper('green', (5.0, 2.1, 1.1), 0.21, 0.297),
    Paper('blue', (5.0, 3.3, 1.3), 0.21, 0.297),
)
ROOM = rectangle_room(5.0, 4.2, PAPERS)


def scene_of(room):
    """Textured walls; the papers hang on a plain grey strip of their wall."""
    textured = textured_room(rectangle_room(5.0, 4.2), seed=4, feature_m=0.045)
    strip = Board(
        np.array([5.0 - 5e-6, 2.2, 1.2]), np.array([-1.0, 0, 0]), 2.9, 0.75, flat_texture(GREY)
    )
    return Scene((*textured.boards, strip, *(paper_board(p, room) for p in room.papers)))


SCENE = scene_of(ROOM)

SIGMA = np.diag([0.01, 0.01, 0.004]) ** 2


def sweep_at(pose, mount=MOUNT, known=None):
    """Sweep at a pose; `known` is what is given of it."""
    place = None if known is None else PoseEstimate(0, np.array(known), SIGMA)
    return replace(_drawn(tuple(pose), mount), pose_map_base=place)


@cache
def _drawn(pose, mount):
    rng = np.random.default_rng(0)
    return draw_sweep(SCENE, CAMERA, mount, np.array(pose), TURN, rng=rng)


def axis_of(pose):
    """Viewpoint (3,) of a panorama taken by the base at `pose`."""
    x, y, _ = MOUNT.axis_pose_map(pose)
    return np.array([x, y, MOUNT.axis_xyz[2]])


@pytest.fixture(scope='module')
def panoramas():
    return [panorama_from_sweep(sweep_at(pose), ROOM, MOUNT) for pose in POSES]


@pytest.fixture(scope='module')
def learned(panoramas):
    return learn_from_panoramas(panoramas, ROOM, LearningConfig())


def test_panoramas_know_where_they_were_taken(panoramas):
    for panorama, pose in zip(panoramas, POSES, strict=True):
        error = np.append(
            panorama.center_map - axis_of(pose), wrap_rad(panorama.heading_rad - pose[2])
        )
        assert np.abs(error[:2]).max() < 0.015
        assert abs(error[3]) < np.radians(0.3)
        assert np.abs(error / np.sqrt(np.diag(panorama.covariance))).max() < 3.5


def errors_of(learned):
    """Errors (n, 3) of landmarks, and covariances: what is truly seen at their candidates."""
    errors, covariances = [], []
    for view, (candidates, outcomes) in enumerate(
        zip(learned.candidates, learned.outcomes, strict=True)
    ):
        axis, cylinder = axis_of(POSES[view]), learned.panoramas[view].cylinder
        for candidate, outcome in zip(candidates, outcomes, strict=True):
            if isinstance(outcome, Refusal):
                continue
            azimuth = float(cylinder.azimuth_rad(candidate.column)) + POSES[view][2]
            reach = float(ROOM.raycast(axis[:2], azimuth)[0])
            up = axis[2] + reach * float(cylinder.tangent(candidate.row))
            xy = axis[:2] + reach * np.array([np.cos(azimuth), np.sin(azimuth)])
            errors.append(outcome.position - [*xy, up])
            covariances.append(outcome.covariance)
    return np.array(errors), np.array(covariances)


def test_landmarks_are_where_they_are(learned):
    errors, covariances = errors_of(learned)
    assert np.linalg.norm(errors, axis=1).max() < 0.04
    assert np.sqrt(np.mean(errors[:, :2] ** 2)) < 0.012
    nees = np.einsum('ni,nij,nj->n', errors, np.linalg.inv(covariances), errors)
    # All share the errors of two places, so that one world is one draw of few numbers.
    assert np.mean(nees) / 3.0 < 2.0
    assert nees.max() / 3.0 < 8.0


def test_learning_again_gives_the_same(panoramas, learned):
    log = StageLog()
    again = learn_from_panoramas(panoramas, ROOM, LearningConfig(), log)
    np.testing.assert_array_equal(again.map.positions, learned.map.positions)
    np.testing.assert_array_equal(again.map.covariances, learned.map.covariances)
    assert set(log.seconds) == {'attention', 'stereo', 'adjustment', 'election'}
    assert all(m > 0.0 for m in log.peak_memory_mb.values())


def test_a_place_known_from_elsewhere_needs_no_papers():
    bare = replace(ROOM, papers=())
    panorama = panorama_from_sweep(sweep_at(POSES[0], known=POSES[0]), bare, MOUNT)
    np.testing.assert_allclose(panorama.center_map, axis_of(POSES[0]))
    assert panorama.heading_rad == POSES[0][2]
    # The lever from the base to the pan axis carries the heading's error along.
    lever = se2.rotation(POSES[0][2]) @ MOUNT.axis_xyz[:2]
    cross = [-lever[1] * 0.004**2, lever[0] * 0.004**2]
    np.testing.assert_allclose(panorama.covariance[:2, 3], cross, rtol=1e-3)


def test_a_place_that_papers_contradict_is_refused():
    away, near = (sweep_at(POSES[0], known=POSES[0] + [x, 0.0, 0.0]) for x in (0.1, 0.0))
    with pytest.raises(LandmarkNavError, match=r'sweep/pose and the papers disagree by \d'):
        panorama_from_sweep(away, ROOM, Calibration.exact(MOUNT))
    panorama_from_sweep(near, ROOM, MOUNT)


@pytest.mark.parametrize(('rise_m', 'lean_deg'), [(-0.015, (0.4, 0.0)), (0.1, (-1.0, 2.5))])
def test_height_and_tilt_by_the_papers_are_used(rise_m, lean_deg):
    """Panoramas are taken where they are, and say what the mount is, whatever was given."""
    x, y, z = MOUNT.axis_xyz
    true = replace(
        MOUNT, axis_xyz=(x, y, z + rise_m), axis_rpy=(*np.radians(lean_deg).tolist(), 0.0)
    )
    panorama = panorama_from_sweep(sweep_at(POSES[0], true), ROOM, MOUNT)
    error = panorama.center_map - axis_of(POSES[0]) - [0.0, 0.0, rise_m]
    assert np.abs(error[:2]).max() < 0.015
    assert abs(error[2]) < 4.0 * np.sqrt(panorama.covariance[2, 2])
    found = panorama.calibration
    for name, angle in zip(('axis_roll', 'axis_pitch'), np.radians(lean_deg), strict=True):
        assert abs(found[name][0] - angle) < 3.5 * found[name][1]
    height = [NAMES.index(name) for name in ('axis_z', 'center_z')]
    sigma = np.sqrt(found.covariance[np.ix_(height, height)].sum())
    assert sigma < 0.7 * np.sqrt(2.0) * 0.02
    assert abs(found.values[height].sum() - z - rise_m) < 3.5 * sigma


def test_an_optical_centre_far_off_the_axis_is_calibrated():
    """The first sweep finds it, the second uses it; the prior gives it as 0 with 2 cm."""
    offset = 0.14, 0.12
    true = replace(MOUNT, optical_center_offset=(*offset, 0.0))
    given = known = Calibration.of_mount(MOUNT)
    for pose in POSES:
        panorama = panorama_from_sweep(sweep_at(pose, true), ROOM, known)
        error = (panorama.center_map - axis_of(pose))[:2]
        assert error @ np.linalg.solve(panorama.covariance[:2, :2], error) < chdtri(2, 1e-3)
        assert np.abs(error).max() < 0.02
        found = panorama.calibration
        for name, value in zip(('center_x', 'center_y'), offset, strict=True):
            assert found[name][1] < 0.01
            assert abs(found[name][0] - value) < 3.5 * found[name][1]
        known = next_prior(given, known, panorama)


def test_poses_without_a_plan_by_a_camera_far_off_its_axis():
    """The walls are found by panoramas that need their distances: their parallax is 5 degrees."""
    true = replace(MOUNT, optical_center_offset=(0.14, 0.12, 0.0))
    relative = np.array([np.zeros(3), se2.relative(*POSES)])
    known = PlaceChain(relative, np.diag([0.0, 0.0, 0.0, 0.03, 0.03, 0.05]) ** 2)
    located = locate_sweeps(
        lambda: (sweep_at(pose, true) for pose in POSES),
        lambda _: [known],
        Calibration.of_mount(true),
        UnmeasuredConfig(),
        StageLog(),
    )
    heading = located.poses.states[1, 2] - located.poses.states[0, 2]
    assert abs(wrap_rad(heading - relative[1, 2])) < np.radians(0.03)
    way = located.poses.states[1, :2] - located.poses.states[0, :2]
    lever = np.array(MOUNT.axis_xyz[:2])
    expected = se2.transform_points(relative[1], lever) - lever
    assert abs(np.arctan2(cross(expected, way), expected @ way)) < np.radians(0.2)


@pytest.mark.parametrize(
    ('rise_m', 'sigmas', 'words'), [(0.5, {}, '.'), (0.06, dict.fromkeys(NAMES, 0.0), 'exact')]
)
def test_a_mount_that_is_implausible_or_contradicts_its_sigma_is_refused(rise_m, sigmas, words):
    x, y, z = MOUNT.axis_xyz
    true, known = replace(MOUNT, axis_xyz=(x, y, z + rise_m)), Calibration.of_mount(MOUNT, sigmas)
    with pytest.raises(LandmarkNavError, match=words) as caught:
        panorama_from_sweep(sweep_at(POSES[0], true), ROOM, known)
    assert len(str(caught.value)) < 250


def test_too_little_to_learn_from_is_refused(panoramas):
    with pytest.raises(LandmarkNavError, match='no frames: take it again'):
        panorama_from_sweep(Sweep(0, ()), ROOM, MOUNT)
    bare = Scene(tuple(wall_board(wall, flat_texture(GREY)) for wall in ROOM.walls))
    rng = np.random.default_rng(1)
    blank = [draw_panorama(bare, axis_of(pose), pose[2], rng=rng) for pose in POSES]
    for views, words in (
        (panoramas[:1], r'needs two panoramas .* not 1: take'),
        ([panoramas[0]] * 2, 'all 2 panoramas are from one place'),
        (blank, 'were found again from another place'),
    ):
        with pytest.raises(LandmarkNavError, match=words) as caught:
            learn_from_panoramas(views, ROOM, LearningConfig())
        assert '\n' not in str(caught.value)


def test_a_room_given_too_long_is_learned_right_and_reported(panoramas, learned, caplog):
    def farther(point):
        return point[0] - 0.04 * (point[0] == 0.0), point[1]

    walls = tuple(replace(w, start=farther(w.start), end=farther(w.end)) for w in ROOM.walls)
    result = learn_from_panoramas(panoramas, replace(ROOM, walls=walls), LearningConfig())
    assert 'room.yaml may be wrong' in caplog.text
    given = {wall.wall_id: wall for wall in result.walls}
    usual = {wall.wall_id: wall for wall in learned.walls}
    for name, wall in given.items():
        off_m = 0.04 if name == 'w' else 0.0
        assert abs(wall.off_m - usual[name].off_m - off_m) < 0.005
        assert abs(usual[name].off_m) < 4.0 * usual[name].sigma_m + 0.002
    west = [k.position[0] for k in result.map.landmarks if k.wall_id == 'w']
    assert abs(np.median(west)) < 0.01


def test_walls_that_stand_elsewhere_carry_no_landmarks(panoramas):
    # North and east are given farther away than they are, south and west are right.
    larger = rectangle_room(6.5, 6.0)
    learned = learn_from_panoramas(panoramas, larger, LearningConfig())
    assert {k.wall_id for k in learned.map.landmarks} == {'s', 'w', ''}
    # What hangs on the others is where it truly is.
    free = np.array([k.position for k in learned.map.landmarks if not k.wall_id])
    assert np.median(ROOM.wall_distances(free[:, :2]).min(-1)) < 0.01


@pytest.mark.parametrize(
    ('focal', 'center', 'sigma'),
    [(0.0, 0.0, 1e-4), (0.0, 1e-3, 1e-3), (0.0, 0.1, 2e-3), (0.1, 0.0, 2e-3)],
)
def test_another_camera_at_the_next_sweep_does_not_have_the_lens_of_the_one_before(
    focal, center, sigma
):
    """Unless its camera_info differs by as little as a driver may round it."""
    given = Calibration.of_mount(MOUNT, {'principal_point': 2e-3})
    lens, value = np.array([1.0, 1.0, 0.5, 0.5, 0.0]), 0.02
    found = replace(
        Calibration.of_mount(MOUNT, {'principal_point': 1e-4}).with_values(principal_point=value),
        intrinsics=lens,
    )
    after: Any = SimpleNamespace(calibration=found)
    for known in (found, next_prior(given, given, after)):
        other = known.for_camera(lens + np.array([focal, focal, center, 0.0, 0.0]), given)
        forgotten = focal + center > 0.01
        assert other['principal_point'][0] == (0.0 if forgotten else value)
        assert other['principal_point'][1] >= 0.99 * sigma
