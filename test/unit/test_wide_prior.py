"""Localization within a wide prior, where landmarks look different from the expected view."""

from dataclasses import replace

import numpy as np
import pytest
from rendered_drives import camera_image, expected, MAP, MOUNT, START

from landmark_nav.calibration import Calibration
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.localization.estimator.config import EstimatorConfig
from landmark_nav.localization.image_stages import ImageStagesConfig
from landmark_nav.localization.observer import Observer
from landmark_nav.localization.relocalization.search import localize_within_prior
from landmark_nav.localization.relocalization.verification import PlaceVerifier, Verification
from landmark_nav.localization.triangulation.model import axis_from_base, bearing_residuals
from landmark_nav.types import LandmarkMap, PoseEstimate

TRUTH = np.array([2.3, 2.1, 0.4])
FRAME = camera_image(TRUTH, -0.2, np.random.default_rng(4))
SURE = np.array([0.02, 0.02, 0.01])
VERIFIER = PlaceVerifier(MAP, MOUNT, ImageStagesConfig())


def reported(error, sigma, truth=TRUTH):
    return PoseEstimate(0, truth + error, np.diag(np.square(sigma)))


def look(prior, frame=FRAME):
    return observer(MAP).look(frame, expected(prior))


def observer(landmarks):
    return Observer(landmarks, Calibration.exact(MOUNT), ImageStagesConfig(), EstimatorConfig())


def errors_of(seen):
    """Of the bearings, against the truth."""
    axis = axis_from_base(reported(np.zeros(3), SURE), MOUNT).pose
    index = MAP.indices(seen.detections.ids)
    return wrap_rad(bearing_residuals(axis, MAP.positions[index, :2], seen.detections.bearing_rad))


@pytest.mark.parametrize('away_m', [0.3, 0.6, 1.0])
@pytest.mark.parametrize('turned_deg', [5.0, -15.0])
def test_a_pose_that_is_known_to_be_far_off_finds_the_same_landmarks(away_m, turned_deg):
    usual = look(reported(np.zeros(3), SURE))
    assert len(usual.detections) >= 4
    sigma = np.array([away_m, away_m, np.radians(abs(turned_deg))])
    for direction in np.arange(6) * np.pi / 3.0:
        x, y = away_m * np.cos(direction), away_m * np.sin(direction)
        seen = look(reported(np.array([x, y, np.radians(turned_deg)]), sigma))
        assert set(seen.detections.ids) == set(usual.detections.ids)
        np.testing.assert_allclose(
            seen.detections.bearing_rad, usual.detections.bearing_rad, atol=3e-4
        )
        assert np.abs(errors_of(seen)).max() < 0.01


def test_a_place_is_reported_as_well_as_its_covariance_states():
    rng = np.random.default_rng(9)
    squares = []
    for _ in range(12):
        truth = START + rng.uniform((0.2, 0.2, -0.2), (1.0, 1.0, 0.2))
        sigma = np.array([0.4, 0.4, 0.15])
        wide = reported(sigma * rng.normal(size=3), sigma, truth)
        place = localize_within_prior(camera_image(truth, 0.0, rng), wide, VERIFIER)
        error = place.estimate.pose - truth
        squares.append(error @ np.linalg.solve(place.estimate.covariance, error))
    assert np.max(squares) < 16.3
    assert 1.0 < np.mean(squares) < 6.0


def test_two_places_that_the_prior_allows_are_none():
    """Every poster hangs a second time, a step aside of the first: a row of posters."""
    shift = np.array([0.0, 0.7, 0.0])
    east = [k for k in MAP.landmarks if k.normal[0] < -0.9]
    again = [
        replace(k, id=k.id + 100, position=k.position + shift, viewpoint=k.viewpoint + shift)
        for k in east
    ]
    wide = reported(np.array([0.0, 0.3, 0.0]), np.array([0.3, 0.5, 0.1]))
    assert isinstance(
        localize_within_prior(
            FRAME, wide, replace(VERIFIER, landmark_map=LandmarkMap(tuple(east)))
        ),
        Verification,
    )
    place = localize_within_prior(
        FRAME, wide, replace(VERIFIER, landmark_map=LandmarkMap(tuple(east + again)))
    )
    assert place.reason == 'not unique'


def test_a_pose_that_is_claimed_to_be_known_is_taken_at_its_word():
    seen = look(reported(np.array([0.6, 0.3, 0.2]), SURE))
    assert len(seen.detections) <= 1
