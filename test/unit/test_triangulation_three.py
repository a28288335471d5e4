from hypothesis import assume, given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import least_squares

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import bearings
from landmark_nav.localization.triangulation.model import (
    bearing_residuals,
    danger_distance,
    triangulate_three,
)

COORDINATE = st.floats(-10.0, 10.0)
LANDMARKS = st.tuples(*[COORDINATE] * 6).map(lambda v: np.array(v).reshape(3, 2))
POSES = st.tuples(COORDINATE, COORDINATE, st.floats(-np.pi, np.pi)).map(np.array)


@given(LANDMARKS, POSES)
def test_recovers_the_pose(landmarks, pose):
    assume(np.hypot(*(landmarks - pose[:2]).T).min() > 0.3)
    assume(danger_distance(pose[:2], landmarks)[1] > 0.05)
    assume(np.abs(np.linalg.det(np.column_stack([landmarks, np.ones(3)]))) > 0.1)
    found = triangulate_three(landmarks, bearings(pose, landmarks))
    np.testing.assert_allclose(found[:2], pose[:2], atol=1e-8)
    assert abs(wrap_rad(found[2] - pose[2])) < 1e-8


def test_agrees_with_brute_force_on_noisy_bearings():
    rng = np.random.default_rng(5)
    compared = 0
    while compared < 100:
        landmarks, pose = rng.uniform(-5.0, 5.0, (3, 2)), rng.uniform(-3.0, 3.0, 3)
        seen = bearings(pose, landmarks) + rng.normal(0.0, 1e-3, 3)
        if danger_distance(pose[:2], landmarks)[1] < 0.15:
            continue
        if np.hypot(*(landmarks - pose[:2]).T).min() < 0.5:
            continue

        def misfit(guess, k=landmarks, b=seen):
            return bearing_residuals(guess, k, b)

        brute = least_squares(misfit, pose, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        found = triangulate_three(landmarks, seen)
        np.testing.assert_allclose(found[:2], brute[:2], atol=1e-9)
        assert abs(wrap_rad(found[2] - brute[2])) < 1e-9
        compared += 1


@pytest.mark.parametrize('second', [[-3.0, 0.0], [3.0, 0.0]])
def test_two_landmarks_in_one_line_with_the_robot(second):
    landmarks = np.array([[1.0, 0.0], second, [0.0, 2.0]])
    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1]):
        pose = np.array([0.0, 0.0, 2.9])
        found = triangulate_three(landmarks[order], bearings(pose, landmarks[order]))
        np.testing.assert_allclose(found, pose, atol=1e-12)
