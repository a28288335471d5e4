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

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.learning.adjustment.problem import Problem, wall_stretches
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
