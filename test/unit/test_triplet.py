"""The chosen triplet is in view and within reach, and the fix has the predicted covariance."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from triplet_room import (
    CAMERA,
    chosen,
    CONFIG,
    DEPTH,
    landmark,
    MOUNT,
    PRIOR,
    random_map,
    select_triplet,
    WIDTH,
)

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.triangulation import triangulate
from landmark_nav.localization.triangulation.model import axis_from_base
from landmark_nav.localization.triplet import CameraState, TripletConfig, visible_landmarks
from landmark_nav.localization.triplet.search import pair_tables, position_variance
from landmark_nav.types import LandmarkMap, PoseEstimate, Refusal


class TestSelection:
    def test_predicted_covariance_is_that_of_the_fix(self) -> None:
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

    def test_no_other_triplet_in_a_view_is_much_better(self) -> None:
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
            select_triplet(
                PRIOR, landmark_map, CAMERA, MOUNT, CONFIG, CameraState(limits_rad=limits)
            )
        )
        assert limits[0] <= triplet.pan_rad <= limits[1]
        wide = (2.0 * np.pi - 0.5, 2.0 * np.pi + 3.0)
        turned = chosen(
            select_triplet(
                PRIOR, landmark_map, CAMERA, MOUNT, CONFIG, CameraState(limits_rad=wide)
            )
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

    def test_hysteresis(self) -> None:
        landmark_map = random_map(40)
        first = chosen(select_triplet(PRIOR, landmark_map, CAMERA, MOUNT, CONFIG))
        moved = PoseEstimate(43, PRIOR.pose + np.array([-0.1, 0.0, 0.0]), PRIOR.covariance)
        kept = chosen(select_triplet(moved, landmark_map, CAMERA, MOUNT, CONFIG, previous=first))
        assert set(kept.ids) == set(first.ids)
        fresh = chosen(select_triplet(moved, landmark_map, CAMERA, MOUNT, CONFIG))
        assert set(fresh.ids) != set(first.ids)
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

    def test_a_triplet_above_the_greatest_sigma_is_refused(self) -> None:
        strict = TripletConfig(max_sigma_m=1e-4)
        found = select_triplet(PRIOR, random_map(40), CAMERA, MOUNT, strict)
        assert isinstance(found, Refusal)
        assert 'accurate enough' in found.reason
