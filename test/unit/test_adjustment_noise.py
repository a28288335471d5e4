"""What is not as it was said to be: noise, walls, places, and matches that are false."""

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
    PRIOR,
    ROOM,
    solve,
    total_covariance,
    world_hung,
    world_of,
)
import numpy as np
import pytest

from landmark_nav.geometry.angles import wrap_rad


@pytest.mark.parametrize(
    ('azimuth', 'tangent', 'relief'), [(1.5e-4, 2e-4, 0.004), (3e-4, 6e-4, 0.012)]
)
def test_noise_is_estimated_from_the_room(azimuth: float, tangent: float, relief: float) -> None:
    rng = np.random.default_rng(8)
    noise, of_landmarks = [], []
    for _ in range(12):
        # As many as a room gives: expected sigmas count for a few measurements, too.
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


def test_places_of_panoramas_that_err_more_than_they_state_are_trusted_less() -> None:
    rng = np.random.default_rng(9)
    world = world_of(rng, 100, hanging_m=0.002, relief_m=0.002)
    scales = []
    for factor in (0.3, 1.0, 3.0):
        found = []
        for _ in range(12):
            given = given_poses(world, rng, factor)
            found.append(solve(world, measurements_of(world, rng), given).noise[3])
        scales.append(np.median(found))
    # Those that agree may share what they err.
    assert scales[0] == 1.0 <= scales[1] < 1.6 < scales[2] < 4.5


def test_steps_between_things_do_not_make_good_places_bad() -> None:
    # Each stretch of wall carries things narrower than itself, each at a depth of its own: their
    # steps look like slopes, and a few slopes like a room that is turned.
    rng = np.random.default_rng(11)
    scales = []
    for _ in range(24):
        world = world_of(rng, 160, flat=True)
        world = world_hung(world, rng, 0.012, 2e-4, thing_m=0.5 * CONFIG.hanging_length_m)
        panoramas = panoramas_at(given_poses(world, rng, 0.2), 0.04 * PRIOR)
        measurements = measurements_of(world, rng, (4e-5, 1e-4))
        scales.append(adjusted(world, measurements, world.points, panoramas).noise[3])
    assert max(scales) < 1.5


def test_heights_that_err_more_than_they_state_do_not_make_the_plan_uncertain() -> None:
    rng = np.random.default_rng(13)
    world = world_of(rng, 100, hanging_m=0.002, relief_m=0.002)
    noise = []
    for _ in range(8):
        given = given_poses(world, rng)
        given[:, 2] = world.poses[:, 2] + 8.0 * (given[:, 2] - world.poses[:, 2])
        noise.append(solve(world, measurements_of(world, rng), given).noise)
    plan, height = np.median(noise, axis=0)[3:5]
    assert plan < 1.6 < 2.0 < height


@pytest.mark.parametrize(('spread', 'least', 'most'), [(5e-4, 0.0, 3e-3), (0.02, 0.01, 0.04)])
def test_how_far_walls_are_off_is_estimated_from_the_room(
    spread: float, least: float, most: float
) -> None:
    rng = np.random.default_rng(14)
    found = []
    for _ in range(8):
        world = world_of(rng, 100, hanging_m=0.002, relief_m=0.002)
        off = rng.normal(0.0, spread, len(ROOM.walls))
        moved = world.points + off[np.asarray(world.walls), None] * ROOM.normals[world.walls]
        world = replace(world, points=moved)
        panoramas = panoramas_at(given_poses(world, rng, 0.2), 0.2**2 * PRIOR)
        measurements = measurements_of(world, rng)
        found.append(adjusted(world, measurements, world.points, panoramas).noise[6])
    assert least < np.median(found) < most


@pytest.mark.parametrize('spread', [0.001, 0.01])
def test_how_differently_things_hang_is_estimated_from_the_room(spread: float) -> None:
    rng = np.random.default_rng(15)
    found = []
    for _ in range(6):
        world = world_of(rng, 150, hanging_m=spread, relief_m=5e-4)
        prior = given_poses(world, rng, 0.2)
        found.append(solve(world, measurements_of(world, rng, (3e-5, 1e-4)), prior).noise[7])
    assert 0.6 < np.median(found) / spread < 1.7


def test_a_hundred_patches_of_a_few_images_state_no_more_of_the_walls_than_a_few_do() -> None:
    rng = np.random.default_rng(16)
    of_landmarks, of_poses = [], []
    for _ in range(12):
        # Two posters a wall, of twenty patches each.
        world = world_of(rng, 160, flat=True)
        points = world.points.copy()
        for k, (index, at) in enumerate(
            zip(world.walls, rng.uniform(-0.25, 0.25, 160), strict=True)
        ):
            wall = ROOM.walls[index]
            along = 0.3 + CONFIG.hanging_length_m * (2, 5)[k // 4 % 2] + at
            points[k, :2] = wall.start + along * wall.along
        world = world_hung(replace(world, points=points), rng, 0.01, 2e-4)
        found = solve(world, measurements_of(world, rng, (2e-4, 2e-4)), given_poses(world, rng))
        error = found.poses - world.poses
        error[:, 3] = wrap_rad(error[:, 3])
        of_poses.append(nees(error, found.pose_covariance).mean())
        of_landmarks.append(nees(found.positions - world.points, total_covariance(found)).mean())
    assert np.mean(of_poses) < 6.0
    assert np.mean(of_landmarks) < 4.5


def test_a_common_distance_from_the_walls_is_no_surprise() -> None:
    rng = np.random.default_rng(3)
    world = world_of(rng, 40, flat=True)
    framed = replace(world, points=world.points + 0.04 * ROOM.normals[world.walls])
    # Well known places distinguish it from a smaller room.
    panoramas = panoramas_at(framed.poses, PRIOR / 400.0)
    measurements = measurements_of(framed, rng)
    found = adjusted(framed, measurements, world.points, panoramas)
    assert found.off_wall_m.mean() == pytest.approx(0.04, abs=0.004)
    assert np.abs((found.positions - framed.points).mean(axis=0)).max() < 0.003
    assert np.median(found.chi_square) < 4.0


def test_one_false_match_does_not_bend_the_rest() -> None:
    rng = np.random.default_rng(4)
    world = world_of(rng, 24)
    measurements = measurements_of(world, rng)
    prior = given_poses(world, rng)
    clean = solve(world, measurements, prior, AS_EXPECTED)
    false = replace(measurements[5][1], azimuth_rad=measurements[5][1].azimuth_rad + 0.06)
    measurements[5] = [measurements[5][0], false]
    bent = solve(world, measurements, prior, AS_EXPECTED)

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
    # Election distinguishes them by their misfit.
    assert np.mean(kept) > 0.9
    assert np.mean(refused) > 0.9


def test_walls_that_stand_elsewhere_than_the_room_states_do_not_make_places_overconfident() -> (
    None
):
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
