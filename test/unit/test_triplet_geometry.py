"""Visibility, pan motion and accuracy of triplets."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from triplet_room import CAMERA, CONFIG, DEPTH, landmark, MOUNT, PRIOR, random_map, ROOM, WIDTH

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Wall
from landmark_nav.localization.triplet import visible_landmarks
from landmark_nav.localization.triplet.planning_scene import PanWindows, travel_s
from landmark_nav.localization.triplet.search import pair_tables, position_variance
from landmark_nav.types import LandmarkMap, PoseEstimate


class TestVisibility:
    def test_wall_between(self) -> None:
        behind = landmark(0, (WIDTH, 2.0), (-1.0, 0.0), 1.2)
        behind = replace(behind, viewpoint=np.array([4.25, 2.2, 1.1]))
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

    def test_patch_must_be_whole_in_the_image(self) -> None:
        landmark_map = LandmarkMap((landmark(0, (WIDTH, 2.0), (-1.0, 0.0), 1.2),))
        prior = PoseEstimate(0, np.array([3.0, 2.0, 0.0]), PRIOR.covariance)
        seen = [
            len(visible_landmarks(prior, landmark_map, CAMERA, MOUNT, pan, 0.0, CONFIG))
            for pan in (0.0, 0.36, 0.41, np.pi)
        ]
        assert seen == [1, 1, 0, 0]
        high = visible_landmarks(prior, landmark_map, CAMERA, MOUNT, 0.0, -0.5, CONFIG)
        assert len(high) == 0


class TestGeometry:
    @settings(max_examples=60)
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
                assert limits[0] <= pan <= limits[1]
                assert np.all(np.abs(wrap_rad(pan - azimuth[triple])) <= reach[triple] + 1e-12)

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
