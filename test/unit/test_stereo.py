"""A patch is found again from another position, on its wall or before it, or refused."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import (
    Board,
    candidate_at,
    draw_panorama,
    flat_texture,
    GREY,
    rectangle_room,
    Scene,
    smooth_texture,
    textured_room,
)

from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.learning.adjustment.depth_from_scale import depth_from_scale
from landmark_nav.learning.adjustment.problem import AdjustmentConfig
from landmark_nav.learning.adjustment.solution import Adjustment
from landmark_nav.learning.stereo.reconstruction import reconstruct
from landmark_nav.learning.stereo.wall_patch import (
    own_measurement,
    PatchMeasurement,
    StereoConfig,
    Ties,
    WallPatch,
)
from landmark_nav.learning.stereo.wall_stereo import hypothesize, match_in
from landmark_nav.types import Refusal

ROOM = rectangle_room(6.0, 5.0)
CONFIG = StereoConfig()
CENTERS = (np.array([2.2, 2.0, 1.1]), np.array([3.6, 2.9, 1.1]))
HEADINGS = (0.4, -2.0)
EAST = 1


def views_of(scene, then=None, centers=CENTERS):
    """Panoramas of a scene, the second perhaps of another one."""
    rng = np.random.default_rng(0)
    return [
        draw_panorama(seen, center, heading, rng=rng)
        for seen, center, heading in zip((scene, then or scene), centers, HEADINGS, strict=True)
    ]


def patch_at(panorama, point):
    return hypothesize(candidate_at(panorama, point, 32), 0, panorama, ROOM, CONFIG)


def match_at(panoramas, point, config=CONFIG):
    patch = patch_at(panoramas[0], point)
    assert isinstance(patch, WallPatch)
    return patch, match_in(patch, 1, panoramas, ROOM, config)


def direction_to(panorama, point):
    """Azimuth in the base frame, and tangent, of a point."""
    d = point - panorama.center_map
    return np.array([np.arctan2(d[1], d[0]) - panorama.heading_rad, d[2] / np.hypot(d[0], d[1])])


@pytest.fixture(scope='module')
def scene():
    return textured_room(ROOM, seed=2, feature_m=0.05)


@pytest.fixture(scope='module')
def panoramas(scene):
    return views_of(scene)


@pytest.mark.parametrize(
    ('point', 'reason'),
    [
        ((6.0, 2.5, 0.0), 'floor or ceiling'),
        ((6.0, 2.5, 2.49), 'floor or ceiling'),
        ((6.0, 0.1, 1.1), 'across the corner'),
    ],
)
def test_what_is_no_patch_of_wall_is_refused(panoramas, point, reason):
    found = patch_at(panoramas[0], np.array(point))
    assert reason in found.reason


def measurements_and_errors(panoramas):
    """Measurements in the second view of points on two walls, and their errors (n, 2)."""
    found, errors, rng = [], [], np.random.default_rng(5)
    for k in range(24):
        xy = (6.0, rng.uniform(0.8, 4.2)) if k % 2 else (rng.uniform(1.5, 5.0), 5.0)
        patch, seen = match_at(panoramas, np.array([*xy, rng.uniform(0.8, 1.4)]))
        if isinstance(seen, PatchMeasurement):
            truth = direction_to(panoramas[1], patch.position)
            found.append(seen)
            errors.append([wrap_rad(seen.azimuth_rad - truth[0]), seen.tangent - truth[1]])
    return found, np.array(errors)


@pytest.mark.parametrize('rise_m', [0.0, -0.2, 0.3])
def test_patches_are_found_again_from_the_other_place(scene, panoramas, rise_m):
    """Also where the camera is higher or lower there."""
    center = CENTERS[1] + np.array([0.0, 0.0, rise_m])
    other = draw_panorama(scene, center, HEADINGS[1], rng=np.random.default_rng(3))
    found, errors = measurements_and_errors([panoramas[0], other])
    assert len(found) > 15
    assert {s.panorama for s in found} == {1}
    assert min(s.score for s in found) > CONFIG.min_score
    # A pixel is 4 mrad: a tenth of it, and as far as the covariance says.
    assert np.abs(errors).max() < 8e-4
    sigma = np.array([(s.sigma_azimuth_rad, s.sigma_tangent) for s in found])
    assert np.mean((errors / sigma) ** 2) < 3.0


def hanging(scene, before_wall_m):
    """Scene with a textured board before the east wall, and the board's centre."""
    center = np.array([6.0 - before_wall_m, 2.6, 1.15])
    texture = smooth_texture(np.random.default_rng(9), 1.2, 1.2, 0.05)
    board = Board(center, ROOM.normals[EAST], 1.2, 1.2, texture)
    return replace(scene, boards=(*scene.boards, board)), center


@pytest.mark.parametrize('before_wall_m', [0.05, 0.4])
def test_what_hangs_before_the_wall_is_found_along_the_epipolar_curve(scene, before_wall_m):
    changed, center = hanging(scene, before_wall_m)
    panoramas = views_of(changed)
    patch, seen = match_at(panoramas, center)
    # Where the two rays meet, in plan, is the board, not the wall.
    own = own_measurement(patch, panoramas[0])
    azimuth = np.array([own.azimuth_rad + HEADINGS[0], seen.azimuth_rad + HEADINGS[1]])
    rays = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    reach = np.linalg.solve(np.stack([rays[0], -rays[1]], -1), CENTERS[1][:2] - CENTERS[0][:2])
    met = CENTERS[0][:2] + reach[0] * rays[0]
    assert met[0] == pytest.approx(center[0], abs=0.015)


def test_what_only_one_place_sees_is_refused(scene):
    changed, center = hanging(scene, 0.8)
    _, seen = match_at(views_of(changed, scene), center)
    assert seen.reason in (
        'low correlation',
        'ambiguous',
        'peak at the border of the search window',
    )


def test_the_corner_of_furniture_at_its_wall_is_no_patch_of_it():
    # Its rear edge lies on the wall, so both outlines agree; within them each place sees another
    # part of its side, which reaches half a metre into the room.
    grey = Board(np.array([6.0, 2.5, 1.25]), ROOM.normals[EAST], 5.0, 2.5, flat_texture(GREY))
    front, rear = np.array([5.5, 4.1, 0.6]), np.array([6.0, 3.3, 1.2])
    wood = smooth_texture(np.random.default_rng(5), 1.6, 1.2, 0.1) - 80.0
    side = Board(np.array([5.75, rear[1], 0.6]), -ROOM.normals[0], 0.5, 1.2, wood)
    face = Board(front, ROOM.normals[EAST], 1.6, 1.2, wood)
    panoramas = views_of(Scene((grey, side, face)))
    _, seen = match_at(panoramas, rear)
    assert seen.reason == 'not flat'
    _, seen = match_at(panoramas, rear, replace(CONFIG, max_displaced_px=100.0))
    assert isinstance(seen, PatchMeasurement)


@pytest.mark.parametrize(
    ('moved', 'reason'),
    [
        ({'center_map': CENTERS[0] + [0.05, 0.0, 0.0]}, 'too little parallax'),
        ({'center_map': np.array([2.0, -1.0, 1.1])}, 'hidden from the other place'),
        ({'center_map': np.array([5.8, 4.5, 1.1])}, 'too oblique from the other place'),
        ({}, 'not covered'),
    ],
)
def test_what_the_other_place_does_not_show_is_refused(panoramas, moved, reason):
    covered = np.full_like(panoramas[1].mask, bool(moved))
    other = replace(panoramas[1], mask=covered, **moved)
    _, seen = match_at([panoramas[0], other], np.array([6.0, 2.2, 1.1]))
    assert reason in seen.reason


# Not equally high: epipolar curves run up and down as well.
UNEVEN = (CENTERS[0], np.array([3.0, 3.1, 1.2]))
TO_WEST = ROOM.normals[EAST]


def board(center, normal):
    texture = smooth_texture(np.random.default_rng(8), 0.7, 0.7, 0.04)
    return Board(np.array(center), normal, 0.7, 0.7, texture)


@pytest.mark.parametrize(
    ('center', 'angle'), [((4.6, 2.6, 1.1), 0.0), ((4.1, 2.3, 1.3), 0.0), ((4.4, 2.9, 1.1), 0.4)]
)
def test_what_stands_before_a_wall_is_found_at_its_depth(scene, center, angle):
    center = np.array(center)
    normal = np.append(se2.rotation(angle) @ TO_WEST[:2], 0.0)
    furnished = replace(scene, boards=(*scene.boards, board(center, normal)))
    panoramas = views_of(furnished, centers=UNEVEN)
    _, match = match_at(panoramas, center)
    assert isinstance(match, Refusal)
    candidates = [[candidate_at(panoramas[0], center, 30)], []]
    found = reconstruct(panoramas, candidates, ROOM, CONFIG)
    assert found.walls == [-1]
    (patch,) = found.patches
    assert patch.position == pytest.approx(center, abs=0.03)
    assert patch.normal @ normal > np.cos(0.25)
    assert [s.panorama for s in found.measurements[0]] == [0, 1]


@pytest.mark.parametrize(('places', 'apart_m', 'count'), [(2, 0.0, 2), (3, 0.0, 1), (3, 0.6, 2)])
def test_what_several_places_show_is_reconstructed_once(scene, places, apart_m, count):
    viewpoints = [*zip(CENTERS, HEADINGS, strict=True), (np.array([3.0, 1.6, 1.1]), 1.0)]
    rng = np.random.default_rng(0)
    panoramas = [draw_panorama(scene, *at, rng=rng) for at in viewpoints[:places]]
    seen, again = (
        replace(candidate_at(panoramas[k], np.array([6.0, y, 1.2]), 32), saliency=saliency)
        for k, y, saliency in ((0, 2.4, 1.0), (-1, 2.4 + apart_m, 0.5))
    )
    candidates = [[seen], *[[]] * (places - 2), [again]]
    ties = Ties(np.empty((0, 3)), [], np.zeros((4 * places, 0)))
    found = reconstruct(panoramas, candidates, ROOM, CONFIG, ties, max_overlap=0.4)
    assert found.origin == [(0, 0), (places - 1, 0)][:count]
    assert len(found.measurements[0]) == places
    assert [len(group) for group in found.outcomes] == [len(group) for group in candidates]


def test_a_reserve_is_measured_where_it_shows_its_depth_best(scene):
    centers = [
        *CENTERS,
        *(np.array([x, y, 1.1]) for x, y in [(3, 1.6), (2.4, 2.2), (2, 3), (3, 4)]),
    ]
    rng = np.random.default_rng(0)
    panoramas = [draw_panorama(scene, center, 0.4, rng=rng) for center in centers]
    point = np.array([6.0, 2.4, 1.2])
    first, again = (candidate_at(panorama, point, 32) for panorama in panoramas[:2])
    candidates = [[first], [replace(again, saliency=0.5)], *[[]] * 4]
    found = reconstruct(panoramas, candidates, ROOM, CONFIG, max_overlap=0.4)
    one, other = ([s.panorama for s in group] for group in found.measurements)
    assert one == [0, 1, 2, 3, 4, 5]
    assert other[0] == 1
    assert 5 in other[1:]
    assert len(other) < len(one)


EAST_WALL = ROOM.normals[1]
# Both look east along y = 2.5.
POSES = np.array([[4.2, 2.5, 1.1, 0.0], [1.8, 2.5, 1.1, 0.0]])
SIZE_SIGMA = 1.5e-3
UNCERTAIN_SIGMA_M = 0.02
ADJUSTMENT = AdjustmentConfig()


def sizes_of(points, rng):
    groups = []
    for point in points:
        reach = (POSES[:, :3] - point) @ EAST_WALL
        spread = np.hypot(SIZE_SIGMA, ADJUSTMENT.nearness_sigma)
        reported = float(np.log(reach[0] / reach[1]) + rng.normal(0.0, spread))
        other = PatchMeasurement(1, 0.0, 0.0, 1e-4, 1e-4, 0.9, reported, SIZE_SIGMA)
        groups.append([PatchMeasurement(0, 0.0, 0.0, 0.0, 0.0, 1.0), other])
    return groups


def on_the_wall(points, depth_sigma):
    """What the walls make of points: on them, and sure of it unless `depth_sigma` says more."""
    n, covariance = len(points), np.diag([depth_sigma, 1e-3, 1e-3]) ** 2
    return Adjustment(
        np.column_stack([np.full(n, 6.0), points[:, 1:]]), np.tile(covariance, (n, 1, 1)),
        np.tile(np.eye(3) * 1e-3, (n, 1, 1)), POSES, np.tile(np.eye(4) * 1e-6, (2, 1, 1)),
        np.zeros(n), np.ones(n), np.ones(8),
    )  # fmt: skip


def placed(points, seed=0):
    return depth_from_scale(
        on_the_wall(points, 1e-3), on_the_wall(points, 0.08),
        sizes_of(points, np.random.default_rng(seed)), np.tile(EAST_WALL, (len(points), 1)),
        ADJUSTMENT, UNCERTAIN_SIGMA_M,
    )  # fmt: skip


def before_wall(rng, count, before_m):
    return np.column_stack([6.0 - before_m, np.full(count, 2.5), rng.uniform(0.9, 1.3, count)])


def test_sizes_place_what_bearings_leave_uncertain_and_state_how_well():
    rng = np.random.default_rng(1)
    before = rng.normal(0.0, 0.026, 400)
    found, free = placed(before_wall(rng, 400, before))
    error = found.off_wall_m - before
    own = found.own_covariance[:, 0, 0]
    sigma = np.sqrt(own + np.sum(found.shared_loading[:, 0] ** 2, 1))
    assert np.std(error) < 0.4 * np.std(before)
    assert 0.85 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.15
    np.testing.assert_allclose(6.0 - found.positions[:, 0], found.off_wall_m, atol=1e-12)
    # Measurements alone show as much, within what walls add.
    assert np.sqrt(free.own_covariance[:, 0, 0]).max() < 0.012
    # What stands well before the wall does not fit it.
    found, _ = placed(before_wall(rng, 50, np.full(50, 0.12)))
    assert found.chi_square.min() > 5.0
    assert found.off_wall_m.min() > 0.06


@pytest.mark.parametrize('before_m', [0.0, 0.03, 0.08, 0.2])
def test_stereo_measures_the_relative_size_on_the_baseline(before_m):
    spot = np.array([6.0 - before_m, 2.5, 1.1])
    rng = np.random.default_rng(11)
    camera_image = Board(spot, EAST_WALL, 0.6, 0.6, smooth_texture(rng, 0.6, 0.6, 0.03))
    panoramas = [
        draw_panorama(Scene((camera_image,)), pose[:3], float(pose[3]), rng=rng) for pose in POSES
    ]
    normalized = []
    for point in spot + [[0.0, y, z] for y in (-0.1, 0.0, 0.1) for z in (-0.1, 0.0, 0.1)]:
        for source in (0, 1):
            candidate = candidate_at(panoramas[source], point, 28 - 10 * source)
            patch = hypothesize(candidate, source, panoramas[source], ROOM, CONFIG)
            assert isinstance(patch, WallPatch)
            seen = match_in(patch, 1 - source, panoramas, ROOM, CONFIG)
            if isinstance(seen, Refusal):
                # Twenty centimetres do not look flat any more.
                assert before_m > 0.1
                continue
            reach = (POSES[:, :3] - spot) @ EAST_WALL
            truth = np.log(reach[source] / reach[1 - source])
            spread = np.hypot(seen.sigma_log_nearer, ADJUSTMENT.nearness_sigma)
            assert spread < 0.01
            normalized.append((seen.log_nearer - truth) / spread)
    assert before_m > 0.1 or len(normalized) == 18
    assert np.sqrt(np.mean(np.square(normalized))) < 1.3
