from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scenes import rectangle_room
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.adjustment import adjust, Adjustment, AdjustmentConfig
from landmark_nav.learning.adjustment.problem import Problem
from landmark_nav.learning.stereo.wall_patch import Sighting
from landmark_nav.types import FloatArray, Panorama

ROOM = rectangle_room(6.0, 5.0)
CONFIG = AdjustmentConfig()
# Sigmas are what they are said to be: nothing of them is estimated.
AS_EXPECTED = AdjustmentConfig(camera_weight=1e9, room_weight=1e9)
# x, y, z, heading: one at the seam of angles.
POSES = np.array([[2.1, 1.9, 1.1, 3.12], [3.9, 2.8, 1.1, -1.4]])
PRIOR = np.diag([0.008, 0.008, 0.005, 0.003]) ** 2
OWN_SIGMA = np.array([2e-4, 3e-4])


@dataclass(frozen=True, eq=False)
class World:
    """True landmarks (n, 3) on walls (n,), and true panorama poses (views, 4)."""

    points: FloatArray
    walls: list[int]
    poses: FloatArray


def world_of(
    rng: np.random.Generator,
    count: int,
    *,
    flat: bool = False,
    hanging_m: float = CONFIG.hanging_sigma_m,
) -> World:
    walls = [k % 4 for k in range(count)]
    points = np.empty((count, 3))
    common = 0.0 if flat else rng.normal(0.0, CONFIG.common_hanging_sigma_m)
    for k, index in enumerate(walls):
        wall = ROOM.walls[index]
        foot = np.array(wall.start) + rng.uniform(0.15, 0.85) * np.subtract(wall.end, wall.start)
        off = common + (0.0 if flat else rng.normal(0.0, hanging_m))
        points[k] = [*(foot + off * wall.normal[:2]), rng.uniform(0.6, 1.7)]
    return World(points, walls, POSES)


def panoramas_at(poses: FloatArray, covariance: FloatArray = PRIOR) -> list[Panorama]:
    blank = np.zeros((4, 16, 3), np.uint8)
    cylinder = Cylinder(16, 4, 2.5, 7.5, 2.0)
    mask = np.ones((4, 16), bool)
    return [
        Panorama(k, blank, mask, cylinder, pose[:3], float(pose[3]), covariance)
        for k, pose in enumerate(poses)
    ]


def sightings_of(
    world: World,
    rng: np.random.Generator | None,
    common: tuple[float, float] = (CONFIG.azimuth_sigma_rad, CONFIG.tangent_sigma),
) -> list[list[Sighting]]:
    """The first view proposed each landmark; the other found it with its own noise as well."""
    groups = []
    for point in world.points:
        group = []
        for view, pose in enumerate(world.poses):
            own = OWN_SIGMA if view else np.zeros(2)
            d = point - pose[:3]
            seen = np.array([np.arctan2(d[1], d[0]) - pose[3], d[2] / np.hypot(d[0], d[1])])
            if rng is not None:
                seen += rng.normal(0.0, np.hypot(own, common))
            # Azimuths come unwrapped, as from columns.
            turns = 2.0 * np.pi * view
            group.append(
                Sighting(view, float(seen[0] + turns), float(seen[1]), *own.tolist(), score=0.9)
            )
        groups.append(group)
    return groups


def solve(
    world: World,
    sightings: list[list[Sighting]],
    prior_poses: FloatArray,
    config: AdjustmentConfig = CONFIG,
) -> Adjustment:
    # From anywhere on the wall near by.
    start = world.points + 0.05
    return adjust(sightings, world.walls, start, panoramas_at(prior_poses), ROOM, config)


def told_poses(world: World, rng: np.random.Generator, factor: float = 1.0) -> FloatArray:
    """Poses as the panoramas tell them; most of the error in height is the camera's."""
    count = len(world.poses)
    error = rng.multivariate_normal(np.zeros(4), PRIOR, count)
    error[:, 2] = np.sqrt(0.9) * rng.normal(0.0, np.sqrt(PRIOR[2, 2]))
    error[:, 2] += np.sqrt(0.1) * rng.normal(0.0, np.sqrt(PRIOR[2, 2]), count)
    return world.poses + factor * error


def draw(rng: np.random.Generator, world: World) -> Adjustment:
    return solve(world, sightings_of(world, rng), told_poses(world, rng))


def total_covariance(found: Adjustment) -> FloatArray:
    loading = found.shared_loading
    return np.asarray(found.own_covariance + loading @ loading.swapaxes(-1, -2))


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.einsum('ni,ni->n', error, np.linalg.solve(covariance, error[..., None])[..., 0])


def test_the_truth_is_found_without_noise() -> None:
    world = world_of(np.random.default_rng(0), 20, flat=True)
    found = solve(world, sightings_of(world, None), world.poses)
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
    # Two sightings of two numbers and a wall, for three unknowns.
    assert 1.0 < np.mean(misfit) < 3.0


@pytest.mark.parametrize(
    ('azimuth', 'tangent', 'hanging'), [(4e-4, 2e-4, 0.003), (3e-4, 6e-4, 0.008)]
)
def test_noise_is_estimated_from_the_room(azimuth: float, tangent: float, hanging: float) -> None:
    rng = np.random.default_rng(8)
    noise, of_landmarks = [], []
    for _ in range(12):
        # As many as a room gives: expected sigmas count for a few measurements, too.
        world = world_of(rng, 150, hanging_m=hanging)
        prior = told_poses(world, rng)
        sightings = sightings_of(world, rng, (azimuth, tangent))
        for group in sightings[:5]:  # false matches say nothing of it
            group[1] = replace(group[1], azimuth_rad=group[1].azimuth_rad + 0.06)
        found = solve(world, sightings, prior)
        noise.append(found.noise)
        error = found.positions - world.points
        of_landmarks.append(nees(error, total_covariance(found))[5:].mean())
        assert found.chi_square[:5].min() > 13.8
    median = np.median(noise, axis=0)
    np.testing.assert_allclose(median[:3], [azimuth, tangent, hanging], rtol=0.3)
    assert 2.0 < np.mean(of_landmarks) < 4.5


def test_places_of_panoramas_that_err_more_than_they_say_are_trusted_less() -> None:
    rng = np.random.default_rng(9)
    world = world_of(rng, 100, hanging_m=0.002)
    scales = []
    for factor in (0.3, 1.0, 3.0):
        found = []
        for _ in range(12):
            told = told_poses(world, rng, factor)
            found.append(solve(world, sightings_of(world, rng), told).noise[3])
        scales.append(np.median(found))
    assert 0.2 < scales[0] < 0.6 < scales[1] < 1.6 < scales[2] < 4.5


def test_heights_that_err_more_than_they_say_do_not_make_the_plan_uncertain() -> None:
    rng = np.random.default_rng(13)
    world = world_of(rng, 100, hanging_m=0.002)
    noise = []
    for _ in range(8):
        told = told_poses(world, rng)
        told[:, 2] = world.poses[:, 2] + 8.0 * (told[:, 2] - world.poses[:, 2])
        noise.append(solve(world, sightings_of(world, rng), told).noise)
    plan, height = np.median(noise, axis=0)[3:5]
    assert plan < 1.6 < 2.0 < height


@pytest.mark.parametrize(('spread', 'least', 'most'), [(5e-4, 0.0, 3e-3), (0.02, 0.01, 0.04)])
def test_how_far_walls_are_off_is_estimated_from_the_room(
    spread: float, least: float, most: float
) -> None:
    rng = np.random.default_rng(14)
    found = []
    for _ in range(8):
        world = world_of(rng, 100, hanging_m=0.002)
        off = rng.normal(0.0, spread, len(ROOM.walls))
        moved = world.points + off[np.asarray(world.walls), None] * ROOM.normals[world.walls]
        world = replace(world, points=moved)
        panoramas = panoramas_at(told_poses(world, rng, 0.2), 0.2**2 * PRIOR)
        sightings = sightings_of(world, rng)
        adjusted = adjust(sightings, world.walls, world.points, panoramas, ROOM, CONFIG)
        found.append(adjusted.noise[-1])
    assert least < np.median(found) < most


def test_the_solution_is_that_of_sparse_least_squares() -> None:
    rng = np.random.default_rng(10)
    third = [3.0, 1.2, 1.1, 0.3]
    # So little noise that nothing is taken for less certain than it says.
    world = replace(world_of(rng, 10, flat=True), poses=np.vstack([POSES, [third]]))
    prior = told_poses(world, rng)
    sightings = sightings_of(world, None)
    found = solve(world, sightings, prior, AS_EXPECTED)
    problem = Problem(sightings, world.walls, panoramas_at(prior), ROOM)
    sigma = np.hypot(problem.own_sigma, [CONFIG.azimuth_sigma_rad, CONFIG.tangent_sigma])
    spread = np.array([1.0, 1.0, CONFIG.common_hanging_sigma_m, CONFIG.wall_sigma_m])
    root = np.linalg.cholesky(np.linalg.inv(problem.prior_covariance(spread)))
    count, shared = len(world.points), problem.prior

    def residuals(x: FloatArray) -> FloatArray:
        at = problem.linearize(x[: 3 * count].reshape(-1, 3), x[3 * count :])
        seen, wall = at.seen / sigma, at.wall / CONFIG.hanging_sigma_m
        return np.concatenate([seen.ravel(), wall, (x[3 * count :] - shared) @ root])

    size = 3 * count + len(shared)
    pattern = lil_matrix((len(residuals(np.append(world.points, shared))), size), dtype=int)
    for k, landmark in enumerate(problem.landmark):
        pattern[2 * k : 2 * k + 2, 3 * landmark : 3 * landmark + 3] = 1
    for k in range(count):
        pattern[2 * len(problem.landmark) + k, 3 * k : 3 * k + 3] = 1
    pattern[:, 3 * count :] = 1
    start = np.append(world.points.ravel(), shared)
    best = least_squares(
        residuals, start, jac_sparsity=pattern, xtol=1e-12, ftol=1e-12, x_scale='jac'
    )
    position = best.x[: 3 * count].reshape(-1, 3)
    np.testing.assert_allclose(position, found.positions, atol=3e-6)


def test_landmarks_share_what_the_poses_err() -> None:
    rng = np.random.default_rng(2)
    world = world_of(rng, 10, flat=True)
    errors, loadings, owns = [], [], []
    for _ in range(250):
        # What hangs there is fixed: what varies is what a map of this world would.
        prior = told_poses(world, rng)
        hung = world_hung(world, rng)
        found = solve(hung, sightings_of(hung, rng), prior, AS_EXPECTED)
        errors.append(found.positions - hung.points)
        loadings.append(found.shared_loading)
        owns.append(found.own_covariance)
    error = np.array(errors).reshape(len(errors), -1)
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


def world_hung(world: World, rng: np.random.Generator) -> World:
    """The world with its landmarks hung anew before the walls."""
    normals = ROOM.normals[world.walls]
    off = rng.normal(0.0, CONFIG.common_hanging_sigma_m)
    each = off + rng.normal(0.0, CONFIG.hanging_sigma_m, len(world.points))
    return replace(world, points=world.points + each[:, None] * normals)


def test_a_common_distance_from_the_walls_is_no_surprise() -> None:
    rng = np.random.default_rng(3)
    world = world_of(rng, 40, flat=True)
    framed = replace(world, points=world.points + 0.04 * ROOM.normals[world.walls])
    # Well known places tell it from a smaller room.
    panoramas = panoramas_at(framed.poses, PRIOR / 400.0)
    sightings = sightings_of(framed, rng)
    found = adjust(sightings, world.walls, world.points, panoramas, ROOM, CONFIG)
    assert found.off_wall_m.mean() == pytest.approx(0.04, abs=0.004)
    assert np.abs((found.positions - framed.points).mean(axis=0)).max() < 0.003
    assert np.median(found.chi_square) < 4.0


def test_one_false_match_does_not_bend_the_rest() -> None:
    rng = np.random.default_rng(4)
    world = world_of(rng, 24)
    sightings = sightings_of(world, rng)
    prior = told_poses(world, rng)
    clean = solve(world, sightings, prior, AS_EXPECTED)
    false = replace(sightings[5][1], azimuth_rad=sightings[5][1].azimuth_rad + 0.06)
    sightings[5] = [sightings[5][0], false]
    bent = solve(world, sightings, prior, AS_EXPECTED)

    others = np.arange(24) != 5
    sigma = np.sqrt(np.diagonal(total_covariance(clean), axis1=1, axis2=2))
    assert np.abs((bent.positions - clean.positions)[others] / sigma[others]).max() < 0.5
    pose_sigma = np.sqrt(np.diagonal(clean.pose_covariance, axis1=1, axis2=2))
    assert np.abs((bent.poses - clean.poses) / pose_sigma).max() < 0.5
    assert bent.chi_square[5] > 13.8
    assert bent.chi_square[others].max() < 13.8


def test_furniture_before_the_walls_does_not_bend_the_rest() -> None:
    # Three of five things seen stand 15 to 40 cm before the walls, which pulls all one way.
    rng = np.random.default_rng(7)
    on_wall = np.arange(40) % 5 < 2
    of_poses, kept, refused = [], [], []
    for _ in range(10):
        world = world_of(rng, 40)
        off = np.where(on_wall, 0.0, rng.uniform(0.15, 0.4, 40))
        furnished = replace(world, points=world.points + off[:, None] * ROOM.normals[world.walls])
        found = draw(rng, furnished)
        error = found.poses - world.poses
        error[:, 3] = wrap_rad(error[:, 3])
        of_poses.append(nees(error, found.pose_covariance).mean())
        kept.append((found.chi_square < 13.8)[on_wall].mean())
        refused.append((found.chi_square > 13.8)[~on_wall].mean())
    assert np.mean(of_poses) / 4.0 < 1.5
    # Election tells them apart by their misfit.
    assert np.mean(kept) > 0.9
    assert np.mean(refused) > 0.9


def test_a_better_known_panorama_makes_better_known_landmarks() -> None:
    world = world_of(np.random.default_rng(5), 20, flat=True)
    sightings = sightings_of(world, None)
    start = world.points
    sizes = []
    for scale in (1.0, 9.0):
        found = adjust(
            sightings, world.walls, start, panoramas_at(POSES, scale * PRIOR), ROOM, CONFIG
        )
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
    two = solve(world, sightings_of(world, None), world.poses)
    three = solve(third, sightings_of(third, None), third.poses)
    assert three.poses.shape == (3, 4)
    np.testing.assert_allclose(three.positions, world.points, atol=1e-6)
    assert np.trace(three.own_covariance.sum(0)) < np.trace(two.own_covariance.sum(0))


def test_walls_that_stand_elsewhere_than_the_room_says_do_not_make_places_overconfident() -> None:
    rng = np.random.default_rng(12)
    errors = []
    for _ in range(30):
        world = world_of(rng, 100, hanging_m=0.004)
        off = rng.normal(0.0, 0.005, len(ROOM.walls))
        moved = world.points + off[np.asarray(world.walls), None] * ROOM.normals[world.walls]
        world = replace(world, points=moved)
        found = draw(rng, world)
        error = found.poses - world.poses
        error[:, 3] = wrap_rad(error[:, 3])
        errors.append(nees(error, found.pose_covariance).mean())
    assert 0.6 < np.mean(errors) / 4.0 < 1.4
