"""Landmarks and panoramas are adjusted together, and err as their covariances say."""

from __future__ import annotations

from dataclasses import replace

from hung_rooms import (
    adjusted,
    AS_EXPECTED,
    CONFIG,
    draw,
    given_poses,
    measurements_of,
    nees,
    panoramas_at,
    places_of,
    POSES,
    PRIOR,
    ROOM,
    solve,
    total_covariance,
    world_hung,
    world_of,
)
import numpy as np
from scipy.optimize import least_squares

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.learning.adjustment import adjust, CALIBRATED
from landmark_nav.learning.adjustment.problem import Problem, wall_stretches
from landmark_nav.learning.stereo.ties import Ties
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement
from landmark_nav.types import FloatArray


def test_the_truth_is_found_without_noise() -> None:
    world = world_of(np.random.default_rng(0), 20, flat=True)
    found = solve(world, measurements_of(world, None), world.poses)
    np.testing.assert_allclose(found.positions, world.points, atol=1e-6)
    error = found.poses - world.poses
    error[:, 3] = wrap_rad(error[:, 3])
    np.testing.assert_allclose(error, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.off_wall_m, 0.0, atol=1e-6)
    assert found.chi_square.max() < 1e-3


def test_landmarks_and_poses_err_as_their_covariances_say() -> None:
    rng = np.random.default_rng(1)
    of_landmarks, of_poses, misfit = [], [], []
    for _ in range(60):
        world = world_of(rng, 24)
        found = draw(rng, world)
        of_landmarks.append(nees(found.positions - world.points, total_covariance(found)).mean())
        error = found.poses - world.poses
        error[:, 3] = wrap_rad(error[:, 3])
        of_poses.append(nees(error, found.pose_covariance).mean())
        misfit.append(found.chi_square.mean())
    assert 0.75 < np.mean(of_landmarks) / 3.0 < 1.25
    assert 0.6 < np.mean(of_poses) / 4.0 < 1.4
    # Two measurements of two numbers and a wall, for three unknowns.
    assert 1.0 < np.mean(misfit) < 3.0


def test_the_solution_is_that_of_least_squares() -> None:
    rng = np.random.default_rng(10)
    third = [3.0, 1.2, 1.1, 0.3]
    # So little noise that nothing is taken for less certain than it says.
    world = replace(world_of(rng, 6, flat=True), poses=np.vstack([POSES, [third]]))
    prior = given_poses(world, rng)
    measurements = measurements_of(world, None)
    found = solve(world, measurements, prior, AS_EXPECTED)
    stretch = wall_stretches(world.points, world.walls, ROOM, CONFIG.hanging_length_m)
    views = panoramas_at(prior)
    problem = Problem(measurements, world.walls, stretch, views, places_of(views), ROOM)
    sigma = np.hypot(problem.own_sigma, [CONFIG.azimuth_sigma_rad, CONFIG.tangent_sigma])
    hanging = (CONFIG.common_hanging_sigma_m, CONFIG.wall_sigma_m, CONFIG.hanging_sigma_m)
    spread = np.array([1.0, 1.0, *hanging])
    root = np.linalg.cholesky(np.linalg.inv(problem.prior_covariance(spread)))
    count, shared = len(world.points), problem.prior

    def residuals(x: FloatArray) -> FloatArray:
        at = problem.linearize(x[: 3 * count].reshape(-1, 3), x[3 * count :])
        seen, wall = at.seen / sigma, at.wall / CONFIG.relief_sigma_m
        return np.concatenate([seen.ravel(), wall, (x[3 * count :] - shared) @ root])

    start = np.append(world.points.ravel(), shared)
    best = least_squares(residuals, start, method='lm', xtol=1e-12, ftol=1e-12, x_scale='jac')
    position = best.x[: 3 * count].reshape(-1, 3)
    np.testing.assert_allclose(position, found.positions, atol=3e-6)


def test_landmarks_share_what_the_poses_err() -> None:
    rng = np.random.default_rng(2)
    world = world_of(rng, 10, flat=True)
    errors, loadings, owns = [], [], []
    for _ in range(250):
        # What hangs there is fixed: what varies is what a map of this world would.
        prior = given_poses(world, rng)
        hung = world_hung(world, rng)
        found = solve(hung, measurements_of(hung, rng), prior, AS_EXPECTED)
        if found.chi_square.max() > 50.0:
            continue  # given to be false
        errors.append(found.positions - hung.points)
        loadings.append(found.shared_loading)
        owns.append(found.own_covariance)
    error = np.array(errors).reshape(len(errors), -1)
    assert len(error) > 220
    measured = error.T @ error / len(error)
    loading = np.mean(loadings, axis=0).reshape(len(world.points) * 3, -1)
    predicted = loading @ loading.T
    for k, own in enumerate(np.mean(owns, axis=0)):
        part = slice(3 * k, 3 * k + 3)
        predicted[part, part] += own
    sigma = np.sqrt(np.diag(predicted))
    assert np.abs(np.sqrt(np.diag(measured)) / sigma - 1.0).max() < 0.25
    # As correlations, the difference of 250 draws is about 1 / sqrt(250).
    difference = (measured - predicted) / np.outer(sigma, sigma)
    assert np.sqrt(np.mean(difference**2)) < 0.1
    correlation = predicted / np.outer(sigma, sigma)
    assert np.abs(correlation - np.diag(np.diag(correlation))).max() > 0.5


def test_a_better_known_panorama_makes_better_known_landmarks() -> None:
    world = world_of(np.random.default_rng(5), 20, flat=True)
    measurements = measurements_of(world, None)
    start = world.points
    sizes = []
    for scale in (1.0, 9.0):
        found = adjusted(world, measurements, start, panoramas_at(POSES, scale * PRIOR))
        sizes.append(np.trace(total_covariance(found), axis1=1, axis2=2).mean())
        # Nobody knows less after the measurements than before.
        assert np.all(
            np.diagonal(found.pose_covariance, axis1=1, axis2=2)
            <= scale * np.diag(PRIOR) * (1.0 + 1e-6)
        )
    assert sizes[0] < sizes[1]


def test_a_third_view_helps() -> None:
    rng = np.random.default_rng(6)
    world = world_of(rng, 16, flat=True)
    third = replace(world, poses=np.vstack([POSES, [[3.0, 1.2, 1.1, 0.3]]]))
    two = solve(world, measurements_of(world, None), world.poses)
    three = solve(third, measurements_of(third, None), third.poses)
    assert three.poses.shape == (3, 4)
    np.testing.assert_allclose(three.positions, world.points, atol=1e-6)
    assert np.trace(three.own_covariance.sum(0)) < np.trace(two.own_covariance.sum(0))


def test_a_calibration_that_is_off_is_found_and_errs_as_it_states() -> None:
    """The optical centre is off: things seem aside and nearer, the more the nearer they are."""
    rng = np.random.default_rng(5)
    prior = Calibration.of_mount(
        PanTiltMount(),
        {'camera_tilt': 1e-4, 'focal_scale': 1e-4, 'axis_roll': 1e-4, 'axis_pitch': 1e-4},
    )
    which = [NAMES.index(name) for name in CALIBRATED]
    errors, of_landmarks, of_both = [], [], []
    for _ in range(40):
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
                [
                    found.calibration_loading[:2] @ loading.T,
                    found.calibration_covariance[:2, :2],
                ],
            ]
        )
        both = np.concatenate([error[0], off[:2]])
        of_both.append(both @ np.linalg.solve(joint, both))
        assert np.sqrt(found.calibration_covariance[1, 1]) < 0.015
    assert 0.6 < np.mean(np.square(errors)) < 1.5
    assert 0.7 < np.mean(of_landmarks) / 3.0 < 1.3
    assert 0.6 < np.mean(of_both) / 5.0 < 1.5


def test_what_hangs_on_no_wall_is_where_its_bearings_meet() -> None:
    rng = np.random.default_rng(31)
    errors, covariances = [], []
    for _ in range(40):
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


def test_ties_join_panoramas_and_are_no_landmarks() -> None:
    rng = np.random.default_rng(32)
    world = world_of(rng, 5)
    prior = given_poses(world, rng)
    views = panoramas_at(prior)
    many = world_of(rng, 150)
    ties = Ties(many.points, measurements_of(many, rng))
    measurements = measurements_of(world, rng)
    start, places = world.points, places_of(views)
    alone = adjust(measurements, world.walls, start, views, places, ROOM, CONFIG)
    joined = adjust(measurements, world.walls, start, views, places, ROOM, CONFIG, ties=ties)
    assert len(joined.positions) == len(joined.own_covariance) == len(joined.chi_square) == 5

    def spread(found: FloatArray) -> float:
        return float(np.trace(found, axis1=1, axis2=2).sum())

    assert spread(joined.pose_covariance) < spread(alone.pose_covariance)


def test_sweeps_that_lean_otherwise_are_found_to() -> None:
    rng = np.random.default_rng(33)
    world = world_of(rng, 80, flat=True)
    lean = np.array([[0.006, -0.004], [-0.006, 0.004]])
    measurements = measurements_of(world, rng)
    for group in measurements:
        for k, seen in enumerate(group):
            roll, pitch = lean[seen.panorama]
            tangent, azimuth = seen.tangent, seen.azimuth_rad
            group[k] = replace(
                seen,
                azimuth_rad=azimuth + tangent * (roll * np.cos(azimuth) + pitch * np.sin(azimuth)),
                tangent=tangent
                + (1.0 + tangent**2) * (pitch * np.cos(azimuth) - roll * np.sin(azimuth)),
            )

    def error(tilt_sigma_rad: float) -> float:
        config = replace(CONFIG, tilt_sigma_rad=tilt_sigma_rad)
        found = solve(world, measurements, world.poses, config)
        return float(np.sqrt(np.mean((found.positions - world.points) ** 2)))

    assert error(0.01) < 0.5 * error(0.0)


def test_tilt_and_waves_have_the_right_slopes() -> None:
    rng = np.random.default_rng(34)
    world = world_of(rng, 8)
    stretch = wall_stretches(world.points, world.walls, ROOM, CONFIG.hanging_length_m)
    views = panoramas_at(world.poses)
    measurements: list[list[PatchMeasurement]] = measurements_of(world, None)
    problem = Problem(
        measurements, world.walls, stretch, views, places_of(views), ROOM,
        tilt_sigma_rad=0.01, wave_sigma_rad=1e-3,
    )  # fmt: skip
    at = problem.linearize(world.points, problem.prior)
    for k in range(len(problem.prior) - 20, len(problem.prior)):
        step = np.zeros(len(problem.prior))
        step[k] = 1e-5
        moved = problem.linearize(world.points, problem.prior + step)
        slope = (at.seen - moved.seen) / 1e-5
        np.testing.assert_allclose(slope, at.by_shared[..., k], atol=1e-6)
