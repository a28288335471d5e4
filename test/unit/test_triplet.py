"""The triplet is in view, the fix has the predicted covariance; where to look when lost."""

from itertools import combinations

from builders import bare_landmark, walls_of
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.triangulation.model import axis_from_base
from landmark_nav.localization.triangulation.robust import triangulate
from landmark_nav.localization.triplet.look_around import (
    LookAround,
    LookAroundConfig,
    views_around,
)
from landmark_nav.localization.triplet.planning_scene import CameraState, PanWindows, travel_s
from landmark_nav.localization.triplet.ranking import LandmarkVisibility, Verdict
from landmark_nav.localization.triplet.search import (
    best_triplets,
    mean_variance,
    pair_tables,
    position_variance,
)
from landmark_nav.localization.triplet.selection import rank_triplets
from landmark_nav.localization.triplet.visibility import TripletConfig, visible_landmarks
from landmark_nav.types import LandmarkMap, PoseEstimate, Refusal, Triplet

WIDTH, DEPTH = 6.6, 4.4
CAMERA = CameraModel(512, 512, 573.0, 573.0, 255.5, 255.5, 'plumb_bob', (-0.1, 0.02))
MOUNT = PanTiltMount(axis_xyz=(0.08, 0.0, 1.1))
CONFIG = TripletConfig()
PRIOR = PoseEstimate(42, np.array([3.0, 2.0, 0.3]), np.diag([0.01, 0.01, 0.005]) ** 2)
ROOM = walls_of([(0, 0), (WIDTH, 0), (WIDTH, DEPTH), (0, DEPTH)], height=2.6)


def select_triplet(*given, **options):
    return rank_triplets(*given, **options).chosen


def landmark(k, xy, normal, z):
    return bare_landmark(
        100 + k, np.array([*xy, z]), np.diag([0.006, 0.006, 0.01]) ** 2,
        shared_loading=np.vstack([0.004 * np.eye(2), np.zeros((1, 2))]),
        normal=np.array([*normal, 0.0]), width_m=0.25,
        viewpoint=np.array([WIDTH / 2.0, DEPTH / 2.0, 1.1]),
    )  # fmt: skip


def random_map(n, seed=0):
    """Landmarks all around a room of 6.6 m x 4.4 m."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(n):
        wall = ROOM[rng.integers(4)]
        share = rng.uniform(0.05, 0.95)
        xy = (1.0 - share) * np.array(wall.start) + share * np.array(wall.end)
        normal = (float(wall.normal[0]), float(wall.normal[1]))
        made.append(landmark(k, (float(xy[0]), float(xy[1])), normal, rng.uniform(0.8, 1.5)))
    return LandmarkMap(tuple(made), walls=ROOM)


def chosen(found):
    assert isinstance(found, Triplet), str(found)
    return found


class TestSelection:
    def test_predicted_covariance_is_that_of_the_fix(self):
        landmark_map = random_map(40)
        triplet = chosen(select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG))
        places = triplet.ids - 100
        fix = triangulate(
            landmark_map.positions[places, :2],
            triplet.bearing_rad,
            np.full(3, CONFIG.bearing_sigma_rad**2),
            landmark_map.joint_covariance_of(places),
        )
        assert not isinstance(fix, Refusal), str(fix)
        axis = axis_from_base(PRIOR, MOUNT)
        np.testing.assert_allclose(fix.pose, axis.pose, atol=1e-9)
        predicted = axis_from_base(
            PoseEstimate(0, PRIOR.pose, triplet.covariance), MOUNT
        ).covariance
        np.testing.assert_allclose(predicted, fix.covariance, rtol=1e-6, atol=1e-12)

    def test_the_view_holds_all_three(self):
        for seed in range(8):
            landmark_map = random_map(40, seed)
            triplet = chosen(select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG))
            view = visible_landmarks(
                PRIOR, landmark_map, CAMERA, MOUNT, triplet.pan_rad, 0.0, CONFIG
            )
            assert set(triplet.ids) <= set(landmark_map.ids[view])
            # The pan halves the span.
            assert np.abs(wrap_rad(triplet.bearing_rad - triplet.pan_rad)).max() < 0.42
            assert triplet.stamp_ns == PRIOR.stamp_ns

    def test_hysteresis(self):
        landmark_map = random_map(40)
        moved = PoseEstimate(43, PRIOR.pose + np.array([-0.1, 0.0, 0.0]), PRIOR.covariance)

        def ids(prior, config=CONFIG, previous=None):
            given = prior, landmark_map, CAMERA, MOUNT, config
            return chosen(select_triplet(*given, previous=previous))

        first, fresh = ids(PRIOR), ids(moved)
        assert set(fresh.ids) != set(first.ids)
        assert set(ids(moved, previous=first).ids) == set(first.ids)
        changed = ids(moved, TripletConfig(hysteresis=0.0), first)
        assert set(changed.ids) == set(fresh.ids)

    def test_landmarks_that_are_seldom_found_are_avoided(self):
        landmark_map = random_map(40)
        first = chosen(select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG))
        rate = np.ones(40)
        rate[first.ids[0] - 100] = 0.01
        other = chosen(select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG, found_rate=rate))
        assert first.ids[0] not in other.ids


SPREAD = LandmarkMap(
    (
        landmark(0, (WIDTH, 2.0), (-1.0, 0.0), 1.2),
        landmark(1, (3.0, DEPTH), (0.0, -1.0), 1.2),
        landmark(2, (0.0, 2.0), (1.0, 0.0), 1.2),
    )
)


@pytest.mark.parametrize(
    ('landmarks', 'config', 'reason'),
    [
        (LandmarkMap(()), CONFIG, 'fewer than three'),
        (SPREAD, CONFIG, 'fit one view'),
        (random_map(40), TripletConfig(max_sigma_m=1e-4), 'accurate enough'),
    ],
)
def test_no_triplet_is_refused(landmarks, config, reason):
    assert reason in select_triplet(PRIOR, landmarks, CAMERA, MOUNT, config).reason
    view = visible_landmarks(PRIOR, LandmarkMap(()), CAMERA, MOUNT, 0.0, 0.0, CONFIG)
    assert len(view) == 0


class TestGeometry:
    @settings(max_examples=60)
    @given(st.integers(0, 10_000), st.integers(3, 9))
    def test_tours_in_one_view_against_a_grid_of_pans(self, seed, n):
        rng = np.random.default_rng(seed)
        azimuth = rng.uniform(-np.pi, np.pi, n)
        reach = rng.uniform(-0.1, 0.6, n)
        limits = (-1.5, 2.0)
        windows = PanWindows.around(azimuth, reach, limits, 0.3, CONFIG)
        copies = np.array(list(combinations(range(len(windows.place)), 3)), dtype=np.intp)
        copies = copies.reshape(-1, 3)
        tours = windows.tours(copies)
        triples = np.array(list(combinations(range(n), 3)))
        pans = np.linspace(*limits, 20001)
        inside = np.abs(wrap_rad(pans[:, None] - azimuth)) <= reach
        for triple in triples:
            # A grid of pans misses views that hardly exist.
            views = pans[inside[:, triple].all(axis=1)]
            mine = (np.sort(windows.place[copies], axis=1) == triple).all(axis=1)
            cost = np.min(tours.cost[mine], initial=np.inf)
            if len(views):
                way = float(np.abs(views - 0.3).min())
                assert cost == pytest.approx(1.0 + travel_s(way, 1.0, 8.0), abs=0.02)
            if np.isfinite(cost):
                pan = tours.pan_rad[mine][np.argmin(tours.cost[mine])]
                assert limits[0] <= pan <= limits[1]
                assert np.all(np.abs(wrap_rad(pan - azimuth[triple])) <= reach[triple] + 1e-12)

    def test_variance_against_the_inverse_matrix(self):
        landmark_map = random_map(12)
        axis = np.array([3.1, 2.2])
        triples = np.array(list(combinations(range(12), 3)))
        seen = pair_tables(axis, landmark_map, np.arange(12), 4e-4)
        traces = position_variance(seen, *triples.T)
        for triple, trace in list(zip(triples, traces, strict=True))[::17]:
            gradient = seen.gradient.T[triple]
            rows = np.stack([2 * triple, 2 * triple + 1], -1).reshape(-1)
            joint = landmark_map.joint_covariance_xy[np.ix_(rows, rows)]
            derivative = np.zeros((3, 6))
            for k in range(3):
                derivative[k, 2 * k : 2 * k + 2] = -gradient[k]
            noise = 4e-4**2 * np.eye(3) + derivative @ joint @ derivative.T
            inverse = np.linalg.inv(np.column_stack([gradient, -np.ones(3)]))
            covariance = inverse @ noise @ inverse.T
            assert trace == pytest.approx(np.trace(covariance[:2, :2]), rel=1e-6)


class TestSearch:
    @settings(max_examples=30)
    @given(st.integers(0, 10_000), st.integers(3, 80), st.sampled_from([0.01, 0.3]))
    def test_pruned_is_exhaustive(self, seed, n, spread_m):
        rng = np.random.default_rng(seed)
        landmark_map = random_map(n, seed)
        points = PRIOR.pose[:2] + spread_m * rng.normal(size=(4, 2))
        tables = pair_tables(points, landmark_map, np.arange(n), 4e-4)
        factor = 1.0 / rng.uniform(0.2, 1.0, n)
        cost = 1.0 + rng.exponential(size=(n, n))
        cost[rng.random((n, n)) < 0.3] = np.inf
        cost = np.maximum(cost, cost.T)
        scores, triplets = best_triplets(tables, factor, cost, 10)
        every = np.array(list(combinations(range(n), 3)))
        i, j, k = every.T
        most = np.maximum(np.maximum(cost[i, j], cost[i, k]), cost[j, k])
        score = mean_variance(tables, every) * factor[every].prod(axis=1) * most
        order = np.argsort(score)[: len(scores)]
        np.testing.assert_allclose(scores, score[order], rtol=1e-9)
        assert {tuple(t) for t in triplets} == {tuple(t) for t in every[order]}
        assert len(scores) == min(10, np.isfinite(score).sum())


class TestRanking:
    def test_reasons(self):
        landmark_map = random_map(40)
        ranking = rank_triplets(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG, CameraState(0.0))
        verdicts = ranking.verdicts()
        assert verdicts[0] is Verdict.CHOSEN
        assert Verdict.CHOSEN not in verdicts[1:]
        assert all(verdict.words for verdict in verdicts)
        assert len(verdicts) == len(ranking.score) > 3
        assert ranking.table()['reason'].tolist() == verdicts
        reported = ranking.landmark_table(landmark_map.ids)
        assert dict(zip(reported['id'], reported['reason'], strict=True)) == dict(
            zip(landmark_map.ids, ranking.visibility, strict=True)
        )
        assert sum(ranking.excluded().values()) == np.count_nonzero(ranking.visibility)
        limited = rank_triplets(
            PRIOR, landmark_map, CAMERA, MOUNT, CONFIG, CameraState(0.0, limits_rad=(-0.5, 0.5))
        )
        assert limited.excluded()[LandmarkVisibility.BEYOND_LIMITS.words] > 10


FULL = (-np.pi, np.pi)
FOV = np.radians(50.0)


@pytest.mark.parametrize('limits', [FULL, (-2.0, 0.5), (0.0, 1.0), (-6.0, 6.0)])
@pytest.mark.parametrize('pan', [-1.5, 0.0, 0.4, 3.0])
def test_the_views_show_all_that_the_joint_reaches_once(limits, pan):
    views = np.array(views_around(limits, FOV, pan))
    assert views.min() >= limits[0]
    assert views.max() <= limits[1]
    shown = np.abs((np.linspace(*limits, 400)[:, None] - views + np.pi) % (2 * np.pi) - np.pi)
    assert shown.min(axis=1).max() <= 0.5 * FOV
    apart = np.abs((views[:, None] - views + np.pi) % (2 * np.pi) - np.pi)
    assert apart[~np.eye(len(views), dtype=bool)].min(initial=1.0) > 0.5 * FOV
    assert np.argmin(np.abs(views - pan)) == 0
    # From one view to the next, with one way back over what has been seen.
    assert np.count_nonzero(np.abs(np.diff(views)) > 1.01 * FOV) <= 1


def looked_around(around, seconds, limit_rad=10.0):
    """Targets, in order, of a joint that follows at 2 rad/s and stops at a limit."""
    pan, targets = 0.0, list[float]()
    for tick in range(round(seconds / 0.1)):
        target = around.pan_at(0.1 * tick, pan, FOV)
        if target is None:
            continue
        if not targets or target != targets[-1]:
            targets.append(target)
        pan = float(np.clip(pan + np.clip(target - pan, -0.2, 0.2), -limit_rad, limit_rad))
    return targets


def test_it_waits_then_goes_round_and_round():
    around = LookAround(LookAroundConfig(after_s=1.0), FULL)
    assert looked_around(around, 0.9) == []
    around.end()
    once = looked_around(around, 14.0)
    assert len({round(target, 6) for target in once}) == 10
    assert len(looked_around(LookAround(LookAroundConfig(after_s=0.0), FULL), 30.0)) > 20
