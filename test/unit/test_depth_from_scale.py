"""Patches on the baseline of two panoramas get their depth from their relative size."""

from hung_rooms import CONFIG, ROOM
import numpy as np
import pytest
from scenes import Board, candidate_at, draw_panorama, Scene, smooth_texture

from landmark_nav.learning.adjustment.depth_from_scale import depth_from_scale
from landmark_nav.learning.adjustment.solution import Adjustment
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement, StereoConfig, WallPatch
from landmark_nav.learning.stereo.wall_stereo import hypothesize, match_in
from landmark_nav.types import Refusal

EAST = ROOM.normals[1]
# Both look east along y = 2.5.
POSES = np.array([[4.2, 2.5, 1.1, 0.0], [1.8, 2.5, 1.1, 0.0]])
SIZE_SIGMA = 1.5e-3
UNCERTAIN_SIGMA_M = 0.02
STEREO = StereoConfig()


def sizes_of(points, rng):
    groups = []
    for point in points:
        reach = (POSES[:, :3] - point) @ EAST
        spread = np.hypot(SIZE_SIGMA, CONFIG.nearness_sigma)
        reported = float(np.log(reach[0] / reach[1]) + rng.normal(0.0, spread))
        groups.append(
            [
                PatchMeasurement(0, 0.0, 0.0, 0.0, 0.0, 1.0),
                PatchMeasurement(1, 0.0, 0.0, 1e-4, 1e-4, 0.9, reported, SIZE_SIGMA),
            ]
        )
    return groups


def on_the_wall(points, depth_sigma):
    """What the walls make of points: on them, and sure of it unless `depth_sigma` says more."""
    n = len(points)
    covariance = np.diag([depth_sigma, 1e-3, 1e-3]) ** 2
    return Adjustment(
        np.column_stack([np.full(n, 6.0), points[:, 1:]]),
        np.tile(covariance, (n, 1, 1)),
        np.tile(np.eye(3) * 1e-3, (n, 1, 1)),
        POSES,
        np.tile(np.eye(4) * 1e-6, (2, 1, 1)),
        np.zeros(n),
        np.ones(n),
        np.ones(8),
    )


def placed(points, seed=0):
    return depth_from_scale(
        on_the_wall(points, 1e-3),
        on_the_wall(points, 0.08),
        sizes_of(points, np.random.default_rng(seed)),
        np.tile(EAST, (len(points), 1)),
        CONFIG,
        UNCERTAIN_SIGMA_M,
    )


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
    camera_image = Board(spot, EAST, 0.6, 0.6, smooth_texture(rng, 0.6, 0.6, 0.03))
    panoramas = [
        draw_panorama(Scene((camera_image,)), pose[:3], float(pose[3]), rng=rng) for pose in POSES
    ]
    normalized = []
    for point in spot + [[0.0, y, z] for y in (-0.1, 0.0, 0.1) for z in (-0.1, 0.0, 0.1)]:
        for source in (0, 1):
            candidate = candidate_at(panoramas[source], point, 28 - 10 * source)
            patch = hypothesize(candidate, source, panoramas[source], ROOM, STEREO)
            assert isinstance(patch, WallPatch)
            seen = match_in(patch, 1 - source, panoramas, ROOM, STEREO)
            if isinstance(seen, Refusal):
                # Twenty centimetres do not look flat any more.
                assert before_m > 0.1
                continue
            reach = (POSES[:, :3] - spot) @ EAST
            truth = np.log(reach[source] / reach[1 - source])
            spread = np.hypot(seen.sigma_log_nearer, CONFIG.nearness_sigma)
            assert spread < 0.01
            normalized.append((seen.log_nearer - truth) / spread)
    assert before_m > 0.1 or len(normalized) == 18
    assert np.sqrt(np.mean(np.square(normalized))) < 1.3
