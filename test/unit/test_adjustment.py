"""Landmarks and panoramas are adjusted together, and err as their covariances say."""

from dataclasses import replace

from builders import nees
from hung_rooms import (
    adjusted,
    AS_EXPECTED,
    COMMON,
    CONFIG,
    given_poses,
    measurements_of,
    panoramas_at,
    places_of,
    POSES,
    ROOM,
    solve,
    total_covariance,
    world_hung,
    world_of,
)
import numpy as np
import pytest
from scipy.optimize import least_squares

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.adjustment.problem import AdjustmentConfig, CALIBRATED, Problem
from landmark_nav.learning.adjustment.solution import adjust
from landmark_nav.learning.least_squares import (
    checked_covariance,
    covariance_of,
    root_of,
    solve_positive,
)


def pose_errors(found, world):
    error = found.poses - world.poses
    error[:, 3] = wrap_rad(error[:, 3])
    return error


def test_the_truth_is_found_without_noise():
    world = world_of(np.random.default_rng(0), 20, flat=True)
    found = solve(world, measurements_of(world, None), world.poses)
    np.testing.assert_allclose(found.positions, world.points, atol=1e-6)
    np.testing.assert_allclose(pose_errors(found, world), 0.0, atol=1e-6)
    np.testing.assert_allclose(found.off_wall_m, 0.0, atol=1e-6)
    assert found.chi_square.max() < 1e-3


def usual(rng):
    return world_of(rng, 24)


def walls_elsewhere(rng):
    world = world_of(rng, 100, hanging_m=0.004)
    return off_walls(world, rng.normal(0.0, 0.005, len(ROOM.walls)))


def off_walls(world, off_m):
    """The world with each of its walls moved by so much."""
    moved = off_m[np.asarray(world.walls), None] * ROOM.normals[world.walls]
    return replace(world, points=world.points + moved)


def posters(rng):
    """Two posters a wall, of twenty patches each."""
    world = world_of(rng, 160, flat=True)
    points = world.points.copy()
    for k, (index, at) in enumerate(zip(world.walls, rng.uniform(-0.25, 0.25, 160), strict=True)):
        wall = ROOM.walls[index]
        along = 0.3 + CONFIG.hanging_length_m * (2, 5)[k // 4 % 2] + at
        points[k, :2] = wall.start + along * wall.along
    return world_hung(replace(world, points=points), rng, 0.01, 2e-4)


@pytest.mark.parametrize(
    ('world_in', 'common', 'count', 'of_poses', 'of_landmarks'),
    [
        (usual, COMMON, 30, (0.6, 1.4), (0.75, 1.25)),
        (walls_elsewhere, COMMON, 15, (0.6, 1.4), (0.5, 1.5)),
        # A hundred patches of a few images state no more of the walls than a few do.
        (posters, (2e-4, 2e-4), 12, (0.0, 1.5), (0.0, 1.5)),
    ],
)
def test_landmarks_and_poses_err_as_their_covariances_say(
    world_in, common, count, of_poses, of_landmarks
):
    rng = np.random.default_rng(1)
    ratios = []
    for _ in range(count):
        world = world_in(rng)
        measurements = measurements_of(world, rng, common)
        found = solve(world, measurements, given_poses(world, rng))
        landmarks = nees(found.positions - world.points, total_covariance(found))
        poses = nees(pose_errors(found, world), found.pose_covariance)
        ratios.append((poses.mean() / 4.0, landmarks.mean() / 3.0))
        assert np.median(found.chi_square) < 3.0
    for ratio, (least, most) in zip(np.mean(ratios, 0), (of_poses, of_landmarks), strict=True):
        assert least < ratio < most


def test_the_solution_is_that_of_least_squares():
    rng = np.random.default_rng(10)
    third = [3.0, 1.2, 1.1, 0.3]
    # So little noise that no measurement is down-weighted.
    world = replace(world_of(rng, 6, flat=True), poses=np.vstack([POSES, [third]]))
    prior = given_poses(world, rng)
    measurements = measurements_of(world, None)
    found = solve(world, measurements, prior, AS_EXPECTED)
    views = panoramas_at(prior)
    problem = Problem(
        measurements, world.walls, views, places_of(views), ROOM,
        ROOM.normals[world.walls], world.points, CONFIG,
    )  # fmt: skip
    sigma = np.hypot(problem.own_sigma, [CONFIG.azimuth_sigma_rad, CONFIG.tangent_sigma])
    hanging = (CONFIG.common_hanging_sigma_m, CONFIG.wall_sigma_m, CONFIG.hanging_sigma_m)
    spread = np.array([1.0, 1.0, *hanging])
    root = np.linalg.cholesky(np.linalg.inv(problem.prior_covariance(spread)))
    count, shared = len(world.points), problem.prior

    def residuals(x):
        at = problem.linearize(x[: 3 * count].reshape(-1, 3), x[3 * count :])
        seen, wall = at.seen / sigma, at.wall / CONFIG.relief_sigma_m
        return np.concatenate([seen.ravel(), wall, (x[3 * count :] - shared) @ root])

    start = np.append(world.points.ravel(), shared)
    best = least_squares(residuals, start, method='lm', xtol=1e-12, ftol=1e-12, x_scale='jac')
    position = best.x[: 3 * count].reshape(-1, 3)
    np.testing.assert_allclose(position, found.positions, atol=3e-6)


def by_shared(problem, at):
    """Derivatives of all measurements by all shared unknowns."""
    out = np.zeros((len(at.seen), 2, len(problem.prior)))
    for group in problem.groups:
        out[group.rows[:, None], :, group.columns] = group.by_columns(at).swapaxes(1, 2)
    return out


@pytest.mark.parametrize('lean', [(0.0, 0.0), (0.05, -0.03)])
def test_an_eccentric_camera_is_modelled_as_its_panorama_was_made(lean):
    rng, offset = np.random.default_rng(3), np.array([0.02, 0.04])
    unit = PanTiltMount(axis_rpy=(*lean, 0.0), optical_center_offset=(*offset, 0.0))
    # As far from the walls as furniture is.
    world = world_of(rng, 24)
    world = replace(world, points=world.points + 0.8 * ROOM.normals[world.walls])
    measurements = []
    for point, group in zip(world.points, measurements_of(world, None), strict=True):
        measurements.append([])
        for s in group:
            pose = world.poses[s.panorama]
            turn = se2.rotation(s.azimuth_rad + pose[3])
            ahead, up = turn.T @ (point - pose[:3])[:2], point[2] - pose[2]
            # The ray from the camera, panned to the point, to where the panorama has the wall.
            wall_m = ROOM.raycast(pose[:2], s.azimuth_rad + pose[3])[0]
            share = (wall_m - offset[0]) / (ahead[0] - offset[0])
            x, y = offset + share * (ahead - offset)
            rise = unit.camera_pose_base(unit.pan_toward_rad(s.azimuth_rad))[1][2]
            tangent = (rise + share * (up - rise)) / np.hypot(x, y)
            azimuth = s.azimuth_rad + np.arctan2(y, x)
            measurements[-1].append(replace(s, azimuth_rad=azimuth, tangent=tangent))
    mount = Calibration.of_mount(unit)
    views = [
        replace(p, calibration=mount, made_with=mount.values) for p in panoramas_at(world.poses)
    ]
    normals = np.zeros((24, 3))
    problem = Problem(
        measurements, world.walls, views, places_of(views), ROOM, normals,
        world.points, replace(CONFIG, tilt_sigma_rad=0.01, wave_sigma_rad=1e-3),
    )  # fmt: skip
    at = problem.linearize(world.points, problem.prior)
    assert np.abs(at.seen).max(axis=0) == pytest.approx(0.0, abs=6e-4)
    step = 1e-6
    for k, change in enumerate(step * np.eye(3)):
        up, down = (
            problem.linearize(world.points + s * change, problem.prior).seen for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(at.by_point[..., k], (down - up) / (2.0 * step), atol=1e-8)
    for k, change in enumerate(step * np.eye(len(problem.prior))):
        up, down = (
            problem.linearize(world.points, problem.prior + s * change).seen for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(
            by_shared(problem, at)[..., k], (down - up) / (2.0 * step), atol=1e-8
        )


def test_a_calibration_that_is_off_is_found_and_errs_as_it_states():
    """The optical centre is off: things seem aside and nearer, the more the nearer they are."""
    rng = np.random.default_rng(5)
    prior = Calibration.of_mount(
        PanTiltMount(),
        {'camera_tilt': 1e-4, 'focal_scale': 1e-4, 'axis_roll': 1e-4, 'axis_pitch': 1e-4},
    )
    which = [NAMES.index(name) for name in CALIBRATED]
    errors, of_landmarks, of_both = [], [], []
    for _ in range(20):
        world = world_of(rng, 24)
        forward, left = rng.normal(0.0, 0.02, 2)
        measurements = []
        for point, group in zip(world.points, measurements_of(world, rng), strict=True):
            reach = [np.hypot(*(point - world.poses[s.panorama, :3])[:2]) for s in group]
            measurements.append(
                [
                    replace(
                        s,
                        azimuth_rad=s.azimuth_rad - left / r,
                        tangent=s.tangent * (1.0 + forward / r),
                    )
                    for s, r in zip(group, reach, strict=True)
                ]
            )
        views = [
            replace(p, calibration=prior, made_with=prior.values)
            for p in panoramas_at(given_poses(world, rng))
        ]
        found = adjusted(world, measurements, world.points, views)
        off = found.calibration - prior.values[which] - [forward, left, 0.0, 0.0, 0.0, 0.0]
        errors.append(off[:2] / np.sqrt(np.diag(found.calibration_covariance)[:2]))
        error = found.positions - world.points
        of_landmarks.append(nees(error, total_covariance(found)).mean())
        # Landmarks and calibration err together as the loadings say.
        loading = found.shared_loading[0]
        joint = np.block(
            [
                [total_covariance(found)[0], loading @ found.calibration_loading[:2].T],
                [found.calibration_loading[:2] @ loading.T, found.calibration_covariance[:2, :2]],
            ]
        )
        both = np.concatenate([error[0], off[:2]])
        of_both.append(both @ np.linalg.solve(joint, both))
        assert np.sqrt(found.calibration_covariance[1, 1]) < 0.015
    assert 0.6 < np.mean(np.square(errors)) < 1.5
    assert 0.7 < np.mean(of_landmarks) / 3.0 < 1.3
    assert 0.6 < np.mean(of_both) / 5.0 < 1.5


@pytest.mark.parametrize(
    ('azimuth', 'tangent', 'relief'), [(1.5e-4, 2e-4, 0.004), (3e-4, 6e-4, 0.012)]
)
def test_noise_is_estimated_from_the_room(azimuth, tangent, relief):
    rng = np.random.default_rng(8)
    noise, of_landmarks = [], []
    for _ in range(6):
        # As many landmarks as in a room: expected sigmas count as a few measurements.
        world = world_of(rng, 150, relief_m=relief)
        prior = given_poses(world, rng)
        measurements = measurements_of(world, rng, (azimuth, tangent))
        for group in measurements[:5]:  # false matches say nothing of it
            group[1] = replace(group[1], azimuth_rad=group[1].azimuth_rad + 0.06)
        found = solve(world, measurements, prior)
        noise.append(found.noise)
        error = found.positions - world.points
        of_landmarks.append(nees(error, total_covariance(found))[5:].mean())
        assert found.chi_square[:5].min() > 13.8
    median = np.median(noise, axis=0)
    np.testing.assert_allclose(median[:3], [azimuth, tangent, relief], rtol=0.3)
    assert 2.0 < np.mean(of_landmarks) < 4.5


MORE = np.array([[3.0, 1.2, 1.1, 0.3], [1.2, 3.9, 1.1, 1.0]])

WITHOUT_WALLS = AdjustmentConfig(
    relief_sigma_m=1.0, camera_weight=1e9, place_weight=1e9, room_weight=1e9
)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('config', [CONFIG, WITHOUT_WALLS], ids=['walls', 'without walls'])
@pytest.mark.parametrize('views', [2, 3, 4])
@pytest.mark.parametrize('off_rad', [0.01, 1.0])
def test_a_false_match_affects_no_other_landmark(off_rad, views, config):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        world = replace(world_of(rng, 14), poses=np.vstack([POSES, MORE])[:views])
        measurements = measurements_of(world, rng)
        wrong = measurements[0][-1]
        turn, rise = (off_rad * rng.standard_normal(2)).tolist()
        measurements[0][-1] = replace(
            wrong, azimuth_rad=wrong.azimuth_rad + turn, tangent=wrong.tangent + rise
        )
        found = solve(world, measurements, given_poses(world, rng), config)
        assert np.abs(found.positions).max() < 100.0
        assert np.abs(found.poses[:, :2] - world.poses[:, :2]).max() < 0.05
        assert np.linalg.eigvalsh(total_covariance(found)).min() > 0.0
        sigma = np.sqrt(np.einsum('nii->ni', total_covariance(found)))
        assert (np.abs(found.positions - world.points) / sigma)[1:].max() < 6.0


def test_a_covariance_is_positive_whatever_the_information():
    rng = np.random.default_rng(3)
    half = rng.standard_normal((6, 3))
    for information in (np.zeros((6, 6)), half @ half.T, np.diag([1e300, 1e-300, 1, 1, 1, 0])):
        covariance = covariance_of(information)
        assert np.isfinite(root_of(covariance)).all()
        assert np.linalg.eigvalsh(covariance).min() >= 0.0
    whole = rng.standard_normal((5, 5))
    whole = whole @ whole.T + np.eye(5)
    np.testing.assert_allclose(covariance_of(whole) @ whole, np.eye(5), atol=1e-9)
    np.testing.assert_allclose(whole @ solve_positive(whole, np.ones(5)), 1.0, atol=1e-9)


@pytest.mark.parametrize('value', [np.nan, np.inf, -1.0, 1e100])
def test_a_covariance_that_is_none_is_refused(value):
    with pytest.raises(LandmarkNavError, match='sweep/pose'):
        checked_covariance(np.diag([value, 1e-4, 1e-4]), np.ones(3), 'sweep/pose')


def test_what_hangs_on_no_wall_is_where_its_bearings_meet():
    rng = np.random.default_rng(31)
    errors, covariances = [], []
    for _ in range(20):
        # All that is known of the walls is wrong for these.
        world = world_of(rng, 20)
        points = world.points + 0.6 * ROOM.normals[world.walls]
        prior = given_poses(world, rng)
        views = panoramas_at(prior)
        free = replace(world, points=points)
        found = adjust(
            measurements_of(free, rng), [-1] * 20, points + 0.05, views, places_of(views), ROOM,
            CONFIG, ROOM.normals[world.walls],
        )  # fmt: skip
        errors.append(found.positions - points)
        covariances.append(total_covariance(found))
    mean = np.mean([nees(e, c).mean() for e, c in zip(errors, covariances, strict=True)])
    assert 0.6 < mean / 3.0 < 1.4
