from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from triplet_room import CAMERA, CONFIG, MOUNT, PRIOR, random_map

from landmark_nav.localization.triplet import CameraState, rank_triplets, TripletConfig
from landmark_nav.localization.triplet.active_camera import ActiveCamera, FoundRecord
from landmark_nav.types import Detections, Refusal, Triplet


def camera_image(found: list[int], missed: list[int] | None = None) -> Detections:
    n = len(found)
    return Detections(
        0,
        np.array(found, dtype=np.int64),
        np.zeros(n),
        np.full(n, 1e-6),
        np.ones(n),
        np.zeros((n, 2)),
        missed=np.array(missed or [], dtype=np.int64),
    )


class TestFoundRecord:
    def test_rate_follows_what_happens(self) -> None:
        rng = np.random.default_rng(4)
        record = FoundRecord(2)
        start = record.rate.copy()
        for _ in range(300):
            found: npt.NDArray[np.bool_] = rng.random(2) < [0.9, 0.2]
            record.note(~found, found)
        assert np.all((start > 0.9) & (start < 1.0))
        assert record.rate == pytest.approx([0.9, 0.2], abs=0.15)
        for _ in range(200):
            record.note(np.array([True, False]), np.array([False, True]))
        assert record.rate[0] < 0.1
        assert 0.95 < record.rate[1] < 1.0


class TestOneView:
    def test_an_image_that_hangs_no_more_is_given_up(self) -> None:
        camera = ActiveCamera(random_map(40), MOUNT, CONFIG)
        first = camera.choose(PRIOR, CAMERA, CameraState(0.0)).chosen
        assert isinstance(first, Triplet)
        gone = int(first.ids[0])
        for _ in range(60):
            camera.saw(camera_image([], [gone]))
        later = camera.choose(PRIOR, CAMERA, CameraState(0.0)).chosen
        assert isinstance(later, Triplet)
        assert gone not in later.ids


class TestSeveralViews:
    def test_goes_from_view_to_view_and_then_chooses_anew(self) -> None:
        config = TripletConfig(views='several')
        camera = ActiveCamera(random_map(40), MOUNT, config)
        ranking = camera.choose(PRIOR, CAMERA, CameraState(0.0))
        chosen = ranking.chosen
        assert isinstance(chosen, Triplet)
        assert len(set(ranking.pan_rad[0])) > 1
        left, pan = set(chosen.ids.tolist()), chosen.pan_rad
        while left:
            here = ranking.ids[0][ranking.pan_rad[0] == pan]
            assert set(here.tolist()) & left
            left -= set(here.tolist())
            assert not camera.done_here
            camera.saw(camera_image(here.tolist()))
            assert camera.done_here
            if left:
                ranking = camera.choose(PRIOR, CAMERA, CameraState(pan))
                assert isinstance(ranking.chosen, Triplet)
                assert set(ranking.chosen.ids) == set(chosen.ids)
                pan = ranking.chosen.pan_rad

    def test_standings_are_those_of_the_whole_map_while_views_are_left(self) -> None:
        landmarks, config = random_map(40), TripletConfig(views='several')
        camera_state = CameraState(0.0, limits_rad=(-2.5, 2.5))
        camera = ActiveCamera(landmarks, MOUNT, config)
        first = camera.choose(PRIOR, CAMERA, camera_state)
        turned = replace(PRIOR, pose=PRIOR.pose - [0.0, 0.0, 0.2])
        later = camera.choose(turned, CAMERA, camera_state)
        assert [set(ids) for ids in later.ids] == [set(first.ids[0])]
        whole = rank_triplets(turned, landmarks, CAMERA, MOUNT, config, camera_state).visibility
        assert np.any(whole != first.visibility)
        np.testing.assert_array_equal(later.landmark_table(landmarks.ids)['reason'], whole)

    def test_without_a_triplet_there_is_nothing_to_go_on_to(self) -> None:
        camera = ActiveCamera(random_map(2), MOUNT, TripletConfig(views='several'))
        assert not camera.done_here
        assert isinstance(camera.choose(PRIOR, CAMERA, CameraState(0.0)).chosen, Refusal)
        camera.saw(camera_image([100]))
        assert not camera.done_here

    def test_does_not_wait_for_what_is_not_found(self) -> None:
        camera = ActiveCamera(random_map(40), MOUNT, TripletConfig(views='several'))
        chosen = camera.choose(PRIOR, CAMERA, CameraState(0.0)).chosen
        assert isinstance(chosen, Triplet)
        for _ in range(40):
            camera.saw(camera_image([], chosen.ids.tolist()))
        later = camera.choose(PRIOR, CAMERA, CameraState(0.0)).chosen
        assert isinstance(later, Triplet)
        assert set(later.ids) != set(chosen.ids)

    def test_gives_up_what_it_is_not_turned_to_in_time(self) -> None:
        config = TripletConfig(views='several', fix_window_s=3.0)
        camera = ActiveCamera(random_map(40), MOUNT, config)
        tours: list[set[int]] = []
        for second in range(12):
            prior = replace(PRIOR, stamp_ns=1_000_000_000 * second)
            chosen = camera.choose(prior, CAMERA, CameraState(0.0)).chosen
            assert isinstance(chosen, Triplet)
            tours.append(set(chosen.ids.tolist()))
        assert tours == [tour for tour in tours[::4] for _ in range(4)]
        assert tours[0] != tours[4] != tours[8]
