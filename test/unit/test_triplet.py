from __future__ import annotations

from itertools import combinations
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import numpy.typing as npt
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.walls import Wall
from landmark_nav.localization.triangulation import triangulate
from landmark_nav.localization.triangulation.model import axis_from_base
from landmark_nav.localization.triplet import (
    Gaze,
    rank_triplets,
    TripletConfig,
    visible_landmarks,
)
from landmark_nav.localization.triplet.geometry import pair_tables, position_variance
from landmark_nav.localization.triplet.ranking import Standing
from landmark_nav.localization.triplet.search import best_triplets, mean_variance
from landmark_nav.localization.triplet.views import PanWindows, travel_s
from landmark_nav.types import Landmark, LandmarkMap, PoseEstimate, Refusal, Triplet

FloatArray = npt.NDArray[np.float64]

WIDTH, DEPTH = 6.6, 4.4
CAMERA = CameraModel(512, 512, 573.0, 573.0, 255.5, 255.5, 'plumb_bob', (-0.1, 0.02))
MOUNT = PanTiltMount(axis_xyz=(0.08, 0.0, 1.1))
CONFIG = TripletConfig()
PRIOR = PoseEstimate(42, np.array([3.0, 2.0, 0.3]), np.diag([0.01, 0.01, 0.005]) ** 2)
ROOM = tuple(
    Wall(name, start, end, 2.6)
    for name, start, end in (
        ('south', (0.0, 0.0), (WIDTH, 0.0)),
        ('east', (WIDTH, 0.0), (WIDTH, DEPTH)),
        ('north', (WIDTH, DEPTH), (0.0, DEPTH)),
        ('west', (0.0, DEPTH), (0.0, 0.0)),
    )
)


def select_triplet(*given: Any, **options: Any) -> Triplet | Refusal:
    return rank_triplets(*given, **options).chosen


def landmark(k: int, xy: tuple[float, float], normal: tuple[float, float], z: float) -> Landmark:
    return Landmark(
        id=100 + k,
        position=np.array([*xy, z]),
        covariance=np.diag([0.006, 0.006, 0.01]) ** 2,
        shared_loading=np.vstack([0.004 * np.eye(2), np.zeros((1, 2))]),
        normal=np.array([*normal, 0.0]),
        width_m=0.25,
        height_m=0.2,
        patch=np.zeros((20, 25), np.uint8),
        viewpoint=np.array([WIDTH / 2.0, DEPTH / 2.0, 1.1]),
        threshold=0.7,
    )


def random_map(n: int, seed: int = 0) -> LandmarkMap:
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


def chosen(found: Triplet | Refusal) -> Triplet:
    assert isinstance(found, Triplet), str(found)
    return found


class TestSelection:
    def test_promised_covariance_is_that_of_the_fix(self) -> None:
        landmark_map = random_map(40)
        triplet = chosen(select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG))
        places = triplet.ids - 100
        rows = np.stack([2 * places, 2 * places + 1], -1).reshape(-1)
        fix = triangulate(
            landmark_map.positions[places, :2],
            triplet.bearing_rad,
            np.full(3, CONFIG.bearing_sigma_rad**2),
            landmark_map.joint_covariance_xy[np.ix_(rows, rows)],
        )
        assert not isinstance(fix, Refusal), str(fix)
        axis = axis_from_base(PRIOR, MOUNT)
        np.testing.assert_allclose(fix.pose, axis.pose, atol=1e-9)
        promised = axis_from_base(
            PoseEstimate(0, PRIOR.pose, triplet.covariance), MOUNT
        ).covariance
        np.testing.assert_allclose(promised, fix.covariance, rtol=1e-6, atol=1e-12)

    def test_no_other_triplet_in_a_view_promises_much_more(self) -> None:
        """Against every triple of visible landmarks, one pan after the other."""
        landmark_map = random_map(25, seed=3)
        triplet = chosen(select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG))
        axis = axis_from_base(PRIOR, MOUNT)
        everything = np.arange(25)
        seen = pair_tables(axis.pose[:2], landmark_map, everything, CONFIG.bearing_sigma_rad)
        best = np.inf
        for pan in np.radians(np.arange(-180, 180, 2)):
            view = visible_landmarks(PRIOR, landmark_map, CAMERA, MOUNT, float(pan), 0.0, CONFIG)
            triples = np.array(list(combinations(view, 3)), dtype=np.intp).reshape(-1, 3)
            best = min(best, *position_variance(seen, *triples.T), np.inf)
        mine = position_variance(seen, *(triplet.ids - 100))
        # Margins for the prior's spread keep the outermost out of the selection.
        assert mine <= 1.35 * best

    def test_the_view_holds_all_three(self) -> None:
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

    def test_joint_limits(self) -> None:
        landmark_map = random_map(40)
        limits = (0.4, 1.1)
        triplet = chosen(
            select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG, Gaze(limits_rad=limits))
        )
        assert limits[0] <= triplet.pan_rad <= limits[1]
        wide = (2.0 * np.pi - 0.5, 2.0 * np.pi + 3.0)
        turned = chosen(
            select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG, Gaze(limits_rad=wide))
        )
        assert wide[0] <= turned.pan_rad <= wide[1]

    def test_pan_across_the_seam(self) -> None:
        prior = PoseEstimate(0, np.array([3.0, 2.0, np.pi]), PRIOR.covariance)
        landmark_map = LandmarkMap(
            tuple(landmark(k, (WIDTH, y), (-1.0, 0.0), 1.2) for k, y in enumerate((1.0, 2.1, 3.1)))
        )
        triplet = chosen(select_triplet(prior, landmark_map, CAMERA, MOUNT, CONFIG))
        assert abs(wrap_rad(triplet.pan_rad - np.pi)) < 0.1
        assert set(triplet.ids) == {100, 101, 102}

    def test_fixed_pan(self) -> None:
        landmark_map = random_map(40)
        for pan in (-2.0, 0.0, 1.0):
            gaze = Gaze(pan, limits_rad=(pan, pan))
            found = select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG, gaze)
            if isinstance(found, Triplet):
                assert found.pan_rad == pan
                view = visible_landmarks(PRIOR, landmark_map, CAMERA, MOUNT, pan, 0.0, CONFIG)
                assert set(found.ids) <= set(landmark_map.ids[view])

    def test_hysteresis(self) -> None:
        landmark_map = random_map(40)
        first = chosen(select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG))
        moved = PoseEstimate(43, PRIOR.pose + np.array([0.02, 0.01, 0.01]), PRIOR.covariance)
        stay = TripletConfig(hysteresis=100.0)
        kept = chosen(select_triplet(moved, landmark_map, CAMERA, MOUNT, stay, previous=first))
        assert set(kept.ids) == set(first.ids)
        fresh = chosen(select_triplet(moved, landmark_map, CAMERA, MOUNT, CONFIG))
        go = TripletConfig(hysteresis=0.0)
        changed = chosen(select_triplet(moved, landmark_map, CAMERA, MOUNT, go, previous=first))
        assert set(changed.ids) == set(fresh.ids)

    def test_landmarks_that_are_seldom_found_are_avoided(self) -> None:
        landmark_map = random_map(40)
        first = chosen(select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG))
        rate = np.ones(40)
        rate[first.ids[0] - 100] = 0.01
        other = chosen(select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG, found_rate=rate))
        assert first.ids[0] not in other.ids

    def test_offset_camera_still_sees_all_three(self) -> None:
        mount = PanTiltMount(
            axis_xyz=(0.1, 0.05, 1.0),
            axis_rpy=(0.0, 0.05, 0.4),
            optical_center_offset=(0.06, 0.03, 0.1),
        )
        landmark_map = random_map(40)
        triplet = chosen(
            select_triplet(PRIOR, landmark_map, CAMERA, mount, CONFIG, Gaze(tilt_rad=0.05))
        )
        view = visible_landmarks(PRIOR, landmark_map, CAMERA, mount, triplet.pan_rad, 0.05, CONFIG)
        assert set(triplet.ids) <= set(landmark_map.ids[view])


class TestSearch:
    @settings(max_examples=30, deadline=None)
    @given(st.integers(0, 10_000), st.integers(3, 80), st.sampled_from([0.01, 0.3]))
    def test_pruned_is_exhaustive(self, seed: int, n: int, spread_m: float) -> None:
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

    @pytest.mark.parametrize('views', ['one', 'several'])
    def test_no_triplet_scores_better_than_the_chosen(self, views: str) -> None:
        """Against all, each judged by its own tour, variance and chance."""
        config = TripletConfig(views=views)
        gaze = Gaze(pan_rad=0.8, limits_rad=(-2.0, 2.0))
        for seed in range(3):
            landmark_map = random_map(18, seed)
            rate = np.random.default_rng(seed).uniform(0.3, 1.0, 18)
            ranking = rank_triplets(
                PRIOR, landmark_map, CAMERA, MOUNT, config, gaze, found_rate=rate
            )
            best = np.inf
            for triple in combinations(np.flatnonzero(ranking.standing == 0), 3):
                alone = LandmarkMap(
                    tuple(landmark_map.landmarks[k] for k in triple), walls=landmark_map.walls
                )
                only = rank_triplets(
                    PRIOR, alone, CAMERA, MOUNT, config, gaze, found_rate=rate[list(triple)]
                )
                best = min(best, *only.score, np.inf)
            assert ranking.score[0] == pytest.approx(best, rel=1e-9)
            assert np.all(np.diff(ranking.score) >= 0.0)


class TestRanking:
    def test_the_spread_of_the_prior_counts(self) -> None:
        """A small one changes next to nothing, a wide one makes near landmarks a gamble."""

        def scores(sigma_m: float) -> tuple[float, set[int]]:
            prior = PoseEstimate(0, PRIOR.pose, np.diag([sigma_m, sigma_m, 0.005]) ** 2)
            # Without margins for it, so that the same views remain.
            config = TripletConfig(margin_sigmas=0.0)
            ranking = rank_triplets(prior, random_map(40), CAMERA, MOUNT, config)
            return float(ranking.score[0]), set(chosen(ranking.chosen).ids.tolist())

        exact, ids = scores(1e-6)
        for sigma_m in (0.01, 0.04, 0.06):
            score, others = scores(sigma_m)
            assert score == pytest.approx(exact, rel=0.02)
            assert others == ids
        assert scores(0.4)[0] > 1.1 * exact

    def test_turning_costs(self) -> None:
        landmark_map = random_map(40)
        hasty = TripletConfig(look_s=0.05)
        for pan in (-2.0, 0.0, 2.0):
            free = rank_triplets(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG)
            near = rank_triplets(PRIOR, landmark_map, CAMERA, MOUNT, hasty, Gaze(pan))
            assert near.travel_s[0] <= travel_s(abs(chosen(free.chosen).pan_rad - pan), 1.0, 8.0)
            assert abs(chosen(near.chosen).pan_rad - pan) < 1.0

    def test_several_views_promise_more(self) -> None:
        several = TripletConfig(views='several', look_s=100.0)
        for seed in range(5):
            landmark_map = random_map(40, seed)
            one = rank_triplets(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG)
            more = rank_triplets(PRIOR, landmark_map, CAMERA, MOUNT, several)
            assert more.sigma_m[0] < 0.5 * one.sigma_m[0]
            assert len(set(more.pan_rad[0])) > 1

    def test_reasons(self) -> None:
        landmark_map = random_map(40)
        ranking = rank_triplets(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG, Gaze(0.0))
        reasons = ranking.reasons()
        assert reasons[0] == 'chosen'
        assert len(reasons) == len(ranking.score) > 3
        assert sum(ranking.excluded().values()) == np.count_nonzero(ranking.standing)
        limited = rank_triplets(
            PRIOR, landmark_map, CAMERA, MOUNT, CONFIG, Gaze(0.0, limits_rad=(-0.5, 0.5))
        )
        assert limited.excluded()[Standing.BEYOND_LIMITS.words] > 10

    def test_a_landmark_above_the_picture_is_cut(self) -> None:
        high = LandmarkMap((landmark(0, (WIDTH, 2.0), (-1.0, 0.0), 3.9), *random_map(9).landmarks))
        ranking = rank_triplets(PRIOR, high, CAMERA, MOUNT, CONFIG)
        assert ranking.standing[0] == Standing.CUT


class TestRefusal:
    def test_empty_map(self) -> None:
        found = select_triplet(PRIOR, LandmarkMap(()), CAMERA, MOUNT, CONFIG)
        assert isinstance(found, Refusal)
        assert 'fewer than three' in found.reason
        view = visible_landmarks(PRIOR, LandmarkMap(()), CAMERA, MOUNT, 0.0, 0.0, CONFIG)
        assert len(view) == 0

    def test_three_that_fit_no_view(self) -> None:
        spread = LandmarkMap(
            (
                landmark(0, (WIDTH, 2.0), (-1.0, 0.0), 1.2),
                landmark(1, (3.0, DEPTH), (0.0, -1.0), 1.2),
                landmark(2, (0.0, 2.0), (1.0, 0.0), 1.2),
            )
        )
        found = select_triplet(PRIOR, spread, CAMERA, MOUNT, CONFIG)
        assert isinstance(found, Refusal)
        assert 'fit one view' in found.reason

    def test_no_use_promising_what_is_useless(self) -> None:
        strict = TripletConfig(max_sigma_m=1e-4)
        found = select_triplet(PRIOR, random_map(40), CAMERA, MOUNT, strict)
        assert isinstance(found, Refusal)
        assert 'accurate enough' in found.reason

    def test_parameters(self) -> None:
        with pytest.raises(LandmarkNavError, match='min_sampling'):
            TripletConfig(min_sampling=0.0)


class TestVisibility:
    def test_wall_between(self) -> None:
        behind = landmark(0, (WIDTH, 2.0), (-1.0, 0.0), 1.2)
        prior = PoseEstimate(0, np.array([2.0, 2.0, 0.0]), PRIOR.covariance)
        view = (CAMERA, MOUNT, 0.0, 0.0, CONFIG)
        assert len(visible_landmarks(prior, LandmarkMap((behind,), walls=ROOM), *view)) == 1
        corners = [
            (0.0, 0.0), (4.0, 0.0), (4.0, 2.5), (4.2, 2.5), (4.2, 0.0), (WIDTH, 0.0),
            (WIDTH, DEPTH), (0.0, DEPTH),
        ]  # fmt: skip
        walls = tuple(
            Wall(str(k), corners[k], corners[(k + 1) % len(corners)], 2.6)
            for k in range(len(corners))
        )
        assert len(visible_landmarks(prior, LandmarkMap((behind,), walls=walls), *view)) == 0

    def test_patch_must_be_whole_in_the_picture(self) -> None:
        landmark_map = LandmarkMap((landmark(0, (WIDTH, 2.0), (-1.0, 0.0), 1.2),))
        prior = PoseEstimate(0, np.array([3.0, 2.0, 0.0]), PRIOR.covariance)
        seen = [
            len(visible_landmarks(prior, landmark_map, CAMERA, MOUNT, pan, 0.0, CONFIG))
            for pan in (0.0, 0.36, 0.41, np.pi)
        ]
        assert seen == [1, 1, 0, 0]
        high = visible_landmarks(prior, landmark_map, CAMERA, MOUNT, 0.0, -0.5, CONFIG)
        assert len(high) == 0

    def test_facing_and_distance(self) -> None:
        turned = LandmarkMap((landmark(0, (WIDTH, 2.0), (1.0, 0.0), 1.2),))
        prior = PoseEstimate(0, np.array([3.0, 2.0, 0.0]), PRIOR.covariance)
        assert not len(visible_landmarks(prior, turned, CAMERA, MOUNT, 0.0, 0.0, CONFIG))
        facing = LandmarkMap((landmark(0, (WIDTH, 2.0), (-1.0, 0.0), 1.2),))
        near = TripletConfig(max_range_m=2.0)
        assert not len(visible_landmarks(prior, facing, CAMERA, MOUNT, 0.0, 0.0, near))


class TestGeometry:
    @settings(max_examples=60, deadline=None)
    @given(st.integers(0, 10_000), st.integers(3, 9))
    def test_tours_in_one_view_against_a_grid_of_pans(self, seed: int, n: int) -> None:
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
                assert np.ptp(pan) == 0.0
                assert limits[0] <= pan[0] <= limits[1]
                assert np.all(np.abs(wrap_rad(pan - azimuth[triple])) <= reach[triple] + 1e-12)

    @settings(max_examples=60, deadline=None)
    @given(st.integers(0, 10_000), st.sampled_from(['one', 'several']))
    def test_a_triplet_costs_the_most_of_its_pairs(self, seed: int, views: str) -> None:
        rng = np.random.default_rng(seed)
        azimuth, reach = rng.uniform(-np.pi, np.pi, 8), rng.uniform(0.05, 0.4, 8)
        limits, now = (-np.pi, rng.uniform(1.0, 4.0)), rng.uniform(-3.0, 1.0)
        windows = PanWindows.around(azimuth, reach, limits, now, TripletConfig(views=views))
        triples = np.array(list(combinations(range(len(windows.place)), 3)), dtype=np.intp)
        i, j, k = (triples := triples.reshape(-1, 3)).T
        place, pairs, tours = windows.place, windows.costs(), windows.tours(triples)
        distinct = (place[i] != place[j]) & (place[i] != place[k]) & (place[j] != place[k])
        most = np.maximum(np.maximum(pairs[i, j], pairs[i, k]), pairs[j, k])
        np.testing.assert_allclose(tours.cost[distinct], most[distinct])
        off = np.abs(wrap_rad(tours.pan_rad - azimuth[place[triples]]))
        assert np.all((off <= reach[place[triples]] + 1e-12)[np.isfinite(tours.cost) & distinct])

    def test_variance_against_the_inverse_matrix(self) -> None:
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

    def test_several_viewpoints_at_once(self) -> None:
        landmark_map = random_map(6)
        points = np.array([[3.0, 2.0], [2.5, 2.4]])
        triples = np.array([[0, 1, 2], [3, 4, 5]])
        both = position_variance(pair_tables(points, landmark_map, np.arange(6), 1e-3), *triples.T)
        one = position_variance(
            pair_tables(points[1], landmark_map, np.arange(6), 1e-3), *triples.T
        )
        assert both.shape == (2, 2)
        np.testing.assert_allclose(both[1], one)

    def test_danger_circle_promises_nothing(self) -> None:
        angles = np.array([0.3, 1.5, 4.0])
        circle = LandmarkMap(
            tuple(
                landmark(k, (2.0 * np.cos(a), 2.0 * np.sin(a)), (1.0, 0.0), 1.2)
                for k, a in enumerate(angles)
            )
        )
        there = 2.0 * np.array([np.cos(2.6), np.sin(2.6)])
        seen = pair_tables(there, circle, np.arange(3), 1e-3)
        assert position_variance(seen, *np.array([[0], [1], [2]]))[0] > 1e6
