"""Relative poses of panoramas: known poses are recovered from matches, or refused."""

from dataclasses import replace
from itertools import combinations

from builders import panorama_of
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.se2 import rot_z, rotation
from landmark_nav.learning.relative_pose.epipolar import center, misses, RayPairs, STATE
from landmark_nav.learning.relative_pose.features import Features, find_features
from landmark_nav.learning.relative_pose.placing import placed
from landmark_nav.learning.relative_pose.poses import relative_poses
from landmark_nav.learning.relative_pose.rigid_sets import rigid_set
from landmark_nav.learning.relative_pose.sheet_tracks import Length
from landmark_nav.learning.relative_pose.two_views import two_views_of
from landmark_nav.learning.unmeasured import PAN_ZERO_SIGMA_RAD
from landmark_nav.types import PlaceChain

EYE_M = 1.1
LEVER = np.array([0.08, 0.02, EYE_M])
POSES = np.array([[0.0, 0.0, 0.0], [1.8, 0.6, 0.5], [2.4, -0.9, -2.0]])
NOISE_RAD = 1e-3


def room_points(rng, count):
    """Points on the walls of a room of 7 m x 5 m around the poses."""
    along, height = rng.uniform(0.0, 24.0, count), rng.uniform(0.2, 2.3, count)
    corners = np.array([[-2.0, -2.5], [5.0, -2.5], [5.0, 2.5], [-2.0, 2.5], [-2.0, -2.5]])
    ends = np.array([0.0, 7.0, 12.0, 19.0, 24.0])
    xy = np.stack([np.interp(along, ends, corners[:, k]) for k in (0, 1)], 1)
    return np.column_stack([xy, height])


def features(poses, points, rng, strangers=60, tilt=None):
    """What panoramas at poses see of points, all of the same or each of its own, with noise."""
    points = np.broadcast_to(points, (len(poses), *points.shape[-2:]))
    looks = rng.normal(size=(points.shape[1], 64))
    seen = []
    for k, pose in enumerate(poses):
        eye = np.array([*pose[:2], EYE_M])
        rays = (points[k] - eye) @ rot_z(pose[2])
        if tilt is not None:
            rays = rays - np.cross(np.append(tilt[k], 0.0), rays)
        own = rng.normal(size=(strangers, 3)) * [1.0, 1.0, 0.3]
        rays = np.vstack([rays, own])
        rays /= np.hypot(rays[:, 0], rays[:, 1])[:, None]
        azimuth = np.arctan2(rays[:, 1], rays[:, 0]) + rng.normal(0, NOISE_RAD, len(rays))
        tangent = rays[:, 2] + rng.normal(0, NOISE_RAD, len(rays))
        look = np.vstack(
            [looks + 0.3 * rng.normal(size=looks.shape), rng.normal(size=(strangers, 64))]
        )
        look /= np.linalg.norm(look, axis=1)[:, None]
        order = rng.permutation(len(rays))
        rays = np.column_stack([np.cos(azimuth), np.sin(azimuth), tangent])
        seen.append(Features(rays[order], look[order].astype(np.float32)))
    return seen


def odometry(poses, sigma_m=0.06, sigma_rad=0.03):
    sigma = np.tile([sigma_m, sigma_m, sigma_rad], len(poses))
    sigma[:3] = 0.0
    return PlaceChain(poses, np.diag(sigma**2))


def found(poses, known, seed, count=250):
    """Poses by panoramas at `poses` and what odometry, or a chain, states of them."""
    rng = np.random.default_rng(seed)
    seen = features(poses, room_points(rng, count), rng)
    known = known if isinstance(known, PlaceChain) else odometry(known)
    return relative_poses(seen, [known], LEVER)


def directions_off(states, poses):
    """Errors of heading and direction, radians, of all sweeps but the first."""
    off = wrap_rad(states[1:, 2] - poses[1:, 2])
    course = [np.arctan2(*(e[1:, :2] - e[0, :2]).T[::-1]) for e in (states, poses)]
    return np.stack([off, wrap_rad(course[0] - course[1])], 1)


@pytest.mark.parametrize('count', [2, 3])
def test_poses_are_recovered_and_scale_is_that_of_odometry(count):
    poses = POSES[:count]
    longer = poses * [1.02, 1.02, 1.0] + np.where(np.arange(count)[:, None] > 0, 0.01, 0.0)
    result = found(poses, longer, seed=count)
    assert np.abs(np.degrees(directions_off(result.states, poses))).max() < 0.2
    ways = [np.linalg.norm(p[1:, :2], axis=1) for p in (result.states, poses, longer)]
    assert ways[0] / ways[1] == pytest.approx(ways[2] / ways[1], abs=0.01)
    assert result.scales[0].inflation == 1.0


MANY = np.array(
    [[0.0, 0.0, 0.0], [2.6, 0.9, 2.0], [0.3, -0.5, -1.0], [2.9, 0.2, 0.4], [0.6, 0.3, 3.0],
     [2.4, 0.3, -2.0], [0.2, 0.6, 1.0]]
)  # fmt: skip


@pytest.mark.parametrize('seed', [1, 2])
def test_sweeps_in_any_order_and_in_groups_are_placed(seed):
    poses = MANY.copy()
    poses[1:] = np.random.default_rng(seed).permutation(poses[1:])
    result = found(poses, poses, seed)
    assert len(result.pairs) >= 2 * len(poses) - 3
    ways = [np.linalg.norm(p[1:, :2], axis=1) for p in (result.states, poses)]
    assert np.abs(ways[0] / ways[1] - 1.0).max() < 0.03
    assert np.abs(np.degrees(directions_off(result.states, poses))).max() < 0.4


def test_more_pairs_do_not_average_what_all_of_them_share():
    sigma = []
    for count in (2, 5):
        rng = np.random.default_rng(9)
        points = room_points(rng, 300)
        seen = np.stack([points] * count)
        seen[1:, points[:, 0] > 4.99, 1] += 0.1  # moved after the first sweep
        panoramas = features(MANY[:count], seen, rng)
        result = relative_poses(panoramas, [odometry(MANY[:count])], LEVER)
        sigma.append(np.linalg.norm(result.shared_errors[2::STATE], axis=1)[1])
        turn = wrap_rad(result.states[1, 2] - MANY[1, 2])
        assert abs(turn) < 3.0 * np.hypot(np.radians(0.1), sigma[-1])
    assert sigma[1] > 0.6 * sigma[0]


@pytest.mark.parametrize('moved_m', [0.1, 0.2])
@pytest.mark.parametrize('wall', [False, True])
def test_things_that_move_together_do_not_make_a_wrong_pose_certain(moved_m, wall):
    rng = np.random.default_rng(11)
    points = room_points(rng, 300)
    seen, later = np.stack([points, points]), rng.uniform(size=300) < 0.35
    if wall:
        later = points[:, 0] > 4.99
    seen[1, later, 1] += moved_m
    pair = features(POSES[:2], seen, rng)
    result = relative_poses(pair, [odometry(POSES[:2])], LEVER)
    # The noise, and what the pair cannot exclude.
    heading, course = directions_off(result.states, POSES[:2])[0]
    sigma = np.hypot(np.radians(0.15), np.linalg.norm(result.shared_errors[STATE + 2]))
    assert abs(heading) < 3.0 * sigma < np.radians(10.0)
    way = POSES[1, :2]
    across = np.array([-way[1], way[0]]) / (way @ way)
    sigma = np.hypot(
        np.radians(0.15), np.linalg.norm(across @ result.shared_errors[STATE : STATE + 2])
    )
    assert abs(course) < 3.0 * sigma


def test_sigma_of_the_heading_contains_errors_that_matches_of_one_direction_share():
    states = np.array([[0.0, 0.0, 0.0, EYE_M, 0.0, 0.0], [1.8, 0.6, 0.5, EYE_M, 0.0, 0.0]])
    normal = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        points = room_points(rng, 300)
        rays, other = ((points - center(s)) @ rot_z(s[2]) for s in states)
        rays, other = (r / np.hypot(r[:, 0], r[:, 1])[:, None] for r in (rays, other))
        sector = (np.arctan2(rays[:, 1], rays[:, 0]) * 10.0 / np.pi).astype(int)
        other[:, 2] += rng.normal(0.0, 2e-3, 21)[sector] + rng.normal(0.0, 5e-4, 300)
        found = rigid_set(states, RayPairs(0, 1, rays, other))
        normal.append((found.state[2] - states[1, 2]) / np.linalg.norm(found.loading[2]))
    assert 0.3 < np.mean(np.square(normal)) < 3.0


def test_the_pose_that_most_agree_on_is_found_among_things_that_moved():
    rng = np.random.default_rng(21)
    points = room_points(rng, 300)
    seen, later = np.stack([points, points]), rng.uniform(size=300) < 0.4
    seen[1, later] += [0.2, 0.1, 0.0]
    result = relative_poses(features(POSES[:2], seen, rng), [odometry(POSES[:2])], LEVER)
    assert np.abs(np.degrees(directions_off(result.states, POSES[:2]))).max() < 0.3


def test_heading_that_slipped_is_recovered_with_less_certain_scale():
    slipped = POSES[:2] + np.array([[0, 0, 0], [0.05, -0.2, 0.12]])
    result = found(POSES[:2], slipped, seed=5)
    assert np.abs(np.degrees(directions_off(result.states, POSES[:2]))).max() < 0.2
    assert result.scales[0].inflation > 1.0


@pytest.mark.parametrize('aside_rad', [0.0, 0.6, np.pi])
def test_slip_that_panoramas_do_not_show_is_inside_the_sigma_of_the_scale(aside_rad):
    way = POSES[1, :2]
    slip = 0.3 / np.hypot(*way) * rotation(aside_rad) @ way
    known = odometry(POSES[:2] + np.array([[0.0, 0.0, 0.0], [*slip, 0.0]]))
    result = found(POSES[:2], replace(known, slip_m=0.1), seed=3)
    scale = np.hypot(*result.states[1, :2] - result.states[0, :2]) / np.hypot(*way)
    assert abs(scale - 1.0) < 3.0 * result.scale_sigma


@pytest.mark.parametrize(
    ('wrong', 'count', 'sigma', 'words'),
    [
        ([-0.5, 1.8, 0.5], 250, (0.06, 0.03), 'odom and panoramas disagree.*pan_axis'),
        ([0.6, 1.8, 1.4], 60, (0.01, 0.005), 'odom and panoramas disagree.*pan_axis'),
        # No slip is blamed for half a turn.
        ([1.8, 0.6, 3.5], 250, (0.06, 0.03), '^(?!.*slip).*look alike'),
    ],
)
def test_odometry_that_contradicts_the_panoramas_is_refused(wrong, count, sigma, words):
    known = odometry(np.array([[0.0, 0.0, 0.0], wrong]), *sigma)
    with pytest.raises(LandmarkNavError, match=words):
        found(POSES[:2], known, 6, count).check()


@pytest.mark.parametrize(('off_rad', 'words'), [(0.12, 'warned'), (0.3, 'refused'), (0.0, '')])
def test_given_poses_that_contradict_the_panoramas_are_named(off_rad, words, caplog):
    turned = POSES[:2] + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, off_rad]])
    result = found(POSES[:2], replace(odometry(turned, 0.02), source='sweep/pose'), seed=6)
    if words == 'refused':
        with pytest.raises(LandmarkNavError, match=r'sweep/pose .* to 2 .* sigma'):
            result.check()
        return
    result.check()
    assert ('sweep/pose and panoramas disagree' in caplog.text) == bool(words)


def test_sweeps_near_each_other_leave_lengths_uncertain_with_a_warning(caplog):
    for apart, warned in ((1.0, False), (0.2, True)):
        poses = POSES[:2] * [apart, apart, 1.0]
        found(poses, replace(odometry(poses, 0.03), slip_m=0.1), seed=6).check()
        assert ('lengths of the map' in caplog.text) == warned


def test_sweeps_are_placed_where_ways_cross_not_as_far_away_as_a_single_sheet_says():
    states = np.zeros((3, STATE))
    states[:, :3] = [[0.0, 0.0, 0.0], [1.8, 0.1, 0.5], [3.2, -0.25, -2.0]]
    found = {pair: two_views_of(states, *pair) for pair in combinations(range(3), 2)}
    way = states[1] - states[0]
    lengths = {(0, 1): Length(float(np.hypot(*way[:2])), 5.0), (1, 2): Length(1.0, 0.0)}
    at = placed(3, found, {}, [], lengths, states[0])
    np.testing.assert_allclose(at[:, :3], states[:, :3], atol=1e-6)
    still = dict.fromkeys(found, Length(0.0, np.inf))
    with pytest.raises(LandmarkNavError, match='odom shows no motion'):
        placed(3, found, {}, [], still, states[0])


def test_panoramas_of_different_rooms_or_of_one_place_are_refused():
    """Whatever odometry states."""
    rng = np.random.default_rng(7)
    apart = [features(POSES[k : k + 1], room_points(rng, 250), rng)[0] for k in range(2)]
    turned = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.4]])
    together = features(turned, room_points(rng, 250), rng)
    for seen, words in ((apart, 'sweep 2 shares too little'), (together, 'from one place')):
        with pytest.raises(LandmarkNavError, match=words):
            relative_poses(seen, [odometry(POSES[:2])], LEVER)


def test_misses_are_zero_for_true_poses_and_their_slopes_are_right():
    rng = np.random.default_rng(10)
    states = np.zeros((2, 6))
    states[:, 3] = EYE_M
    states[1, :3] = POSES[1]
    exact = []
    for state in states:
        rays = (room_points(np.random.default_rng(3), 40) - center(state)) @ rot_z(state[2])
        exact.append(rays / np.hypot(rays[:, 0], rays[:, 1])[:, None])
    pairs = RayPairs(0, 1, *exact)
    off, slopes, before = misses(states, pairs, NOISE_RAD)
    assert np.abs(off).max() < 1e-6
    assert before.all()
    for view in range(2):
        step = np.zeros((2, 6))
        step[view] = 1e-7 * rng.normal(size=6)
        moved = misses(states + step, pairs, NOISE_RAD)[0]
        assert moved - off == pytest.approx(slopes[:, view] @ step[view], abs=1e-5)


@pytest.mark.parametrize('seed', [1, 2])
def test_where_nothing_moved_headings_are_certain(seed):
    result = found(POSES[:2], POSES[:2], seed)
    assert np.linalg.norm(result.shared_errors[2::STATE], axis=1).max() < PAN_ZERO_SIGMA_RAD


def test_features_are_where_they_are_seen():
    """Blobs at known pixels of a panorama: their directions are not displaced."""
    cylinder = Cylinder.with_resolution(300.0, -0.4, 0.4)
    rng = np.random.default_rng(4)
    row, column = np.mgrid[: cylinder.height, : cylinder.width].astype(np.float64)
    grid = np.stack(np.meshgrid(np.arange(40.0, cylinder.width - 40.0, 60.0), [50.0, 110.0]), -1)
    middles = grid.reshape(-1, 2) + rng.uniform(-0.5, 0.5, (grid.size // 2, 2))
    image = np.full(row.shape, 120.0)
    for (x, y), size in zip(middles, rng.uniform(2.0, 6.0, len(middles)), strict=True):
        image += 80.0 * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2.0 * size**2))
    grey = np.clip(image, 0, 255).astype(np.uint8)
    found = find_features(panorama_of(np.dstack([grey] * 3), cylinder)).rays
    apart = np.linalg.norm(cylinder.rays(middles)[:, None] - found, axis=-1)
    nearest = apart.argmin(axis=1)
    seen = apart.min(axis=1) * 300.0 < 1.0
    assert seen.mean() > 0.8
    off = (found[nearest] - cylinder.rays(middles))[seen]
    assert np.abs(np.mean(300.0 * off[:, 2])) < 0.05
    turned = np.arctan2(found[nearest, 1], found[nearest, 0])
    turned -= np.arctan2(cylinder.rays(middles)[:, 1], cylinder.rays(middles)[:, 0])
    assert np.abs(np.mean(300.0 * wrap_rad(turned[seen]))) < 0.05
