"""The ranking of triplets is exact, and includes the costs of pan motion and uncertainty."""

from __future__ import annotations

from itertools import combinations

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from triplet_room import (
    CAMERA,
    chosen,
    CONFIG,
    MOUNT,
    PRIOR,
    random_map,
)

from landmark_nav.localization.triplet import CameraState, rank_triplets, TripletConfig
from landmark_nav.localization.triplet.planning_scene import travel_s
from landmark_nav.localization.triplet.ranking import LandmarkVisibility, Verdict
from landmark_nav.localization.triplet.search import best_triplets, mean_variance, pair_tables
from landmark_nav.types import PoseEstimate


class TestSearch:
    @settings(max_examples=30)
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
        hasty = TripletConfig(dwell_time_s=0.05)
        for pan in (-2.0, 0.0, 2.0):
            free = rank_triplets(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG)
            near = rank_triplets(PRIOR, landmark_map, CAMERA, MOUNT, hasty, CameraState(pan))
            assert near.travel_s[0] <= travel_s(abs(chosen(free.chosen).pan_rad - pan), 1.0, 8.0)
            assert abs(chosen(near.chosen).pan_rad - pan) < 1.0

    def test_reasons(self) -> None:
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
