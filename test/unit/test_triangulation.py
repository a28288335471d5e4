from builders import nees, pose_error
from hypothesis import assume, given
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import bearings
from landmark_nav.localization.triangulation.model import (
    axis_from_base,
    base_from_axis,
    bearing_gradients,
    danger_distance,
    Fix,
    triangulate_three,
)
from landmark_nav.localization.triangulation.robust import triangulate, TriangulationConfig
from landmark_nav.types import PoseEstimate, Refusal

LANDMARKS = np.array([[0.0, 1.0], [2.0, 4.0], [6.0, 3.0], [5.0, 0.0], [6.5, 1.0], [3.5, 4.4]])
POSE = np.array([3.0, 2.0, 2.8])
SIGMA = 1e-3


def variances(n):
    return np.full(n, SIGMA**2)


def expect_fix(found):
    assert isinstance(found, Fix), str(found)
    return found


def expect_refusal(found, reason):
    assert isinstance(found, Refusal), f'a fix at {found.pose}'
    assert reason in str(found)


def joint_map_covariance(n):
    loading = np.tile(np.eye(2), (n, 1)) * 0.01
    return np.asarray(loading @ loading.T + 0.006**2 * np.eye(2 * n))


class TestRecovery:
    @pytest.mark.parametrize('n', [3, 4, 6])
    @pytest.mark.parametrize('heading', [2.8, np.pi, -np.pi + 1e-9, 0.0])
    def test_noiseless(self, n, heading):
        pose = np.array([3.0, 2.0, heading])
        fix = expect_fix(triangulate(LANDMARKS[:n], bearings(pose, LANDMARKS[:n]), variances(n)))
        np.testing.assert_allclose(fix.pose[:2], pose[:2], atol=1e-6)
        assert abs(wrap_rad(fix.pose[2] - heading)) < 1e-6
        assert -np.pi < fix.pose[2] <= np.pi
        assert fix.chi_square < 1e-6

    @pytest.mark.parametrize('seed', range(10))
    def test_finds_mistaken_landmarks(self, seed):
        """Three of ten bearings, to anything: from all of them least squares leads nowhere."""
        rng = np.random.default_rng(seed)
        azimuth = rng.uniform(-np.pi, np.pi, 10)
        away = rng.uniform(1.0, 4.0, (10, 1)) * np.column_stack([np.cos(azimuth), np.sin(azimuth)])
        seen = bearings(POSE, POSE[:2] + away)
        seen[:3] += rng.uniform(0.3, 2.0 * np.pi - 0.3, 3)
        fix = expect_fix(triangulate(POSE[:2] + away, seen, variances(10)))
        np.testing.assert_array_equal(np.flatnonzero(~fix.used), [0, 1, 2])
        np.testing.assert_allclose(fix.pose, POSE, atol=1e-6)


class TestCovariance:
    @pytest.mark.parametrize('n', [3, 4, 6])
    def test_agrees_with_monte_carlo(self, n):
        rng = np.random.default_rng(n)
        landmarks, trials = LANDMARKS[:n], 1500
        covariance = joint_map_covariance(n)
        root = np.linalg.cholesky(covariance)
        config = TriangulationConfig(fit_probability=1.0)
        errors, claimed = [], []
        for _ in range(trials):
            believed = landmarks + (root @ rng.normal(size=2 * n)).reshape(-1, 2)
            seen = bearings(POSE, landmarks) + rng.normal(0.0, SIGMA, n)
            fix = expect_fix(triangulate(believed, seen, variances(n), covariance, config=config))
            errors.append(pose_error(fix.pose, POSE))
            claimed.append(fix.covariance)
        ratio = np.cov(np.array(errors).T) / np.mean(claimed, axis=0)
        # A variance of 1500 draws is known to 3.7 %.
        np.testing.assert_allclose(np.diag(ratio), 1.0, atol=0.12)
        squares = nees(np.array(errors), np.array(claimed))
        assert np.mean(squares) == pytest.approx(3.0, abs=0.25)


class TestRefusal:
    def test_too_few_or_one_landmark_thrice(self):
        for n in (0, 1, 2):
            found = triangulate(LANDMARKS[:n], np.zeros(n), variances(n))
            expect_refusal(found, 'fewer than three')
        found = triangulate(np.tile(LANDMARKS[:1], (3, 1)), np.full(3, 0.3), variances(3))
        expect_refusal(found, 'degenerate')

    def test_danger_circle(self):
        angles = np.array([0.3, 1.5, 4.0])
        landmarks = 2.0 * np.column_stack([np.cos(angles), np.sin(angles)])
        pose = np.array([2.0 * np.cos(2.6), 2.0 * np.sin(2.6), 0.4])
        found = triangulate(landmarks, bearings(pose, landmarks), variances(3))
        assert isinstance(found, Refusal)
        near = pose * [0.96, 0.96, 1.0]
        tight = np.full(3, 1e-10)
        expect_refusal(triangulate(landmarks, bearings(near, landmarks), tight), 'danger circle')

    def test_bearings_that_do_not_meet(self):
        seen = bearings(POSE, LANDMARKS[:4]) + np.array([0.0, 0.1, 0.0, -0.1])
        expect_refusal(triangulate(LANDMARKS[:4], seen, variances(4)), 'do not meet')

    def test_far_from_the_expected_place(self):
        seen = bearings(POSE, LANDMARKS)
        near = PoseEstimate(
            0, POSE + np.array([0.05, 0.0, 0.02]), np.diag([0.05, 0.05, 0.02]) ** 2
        )
        expect_fix(triangulate(LANDMARKS, seen, variances(6), start=near))
        far = PoseEstimate(0, POSE + np.array([1.0, 0.0, 0.0]), near.covariance)
        found = triangulate(LANDMARKS, seen, variances(6), start=far)
        expect_refusal(found, 'far from the expected place')


@pytest.mark.parametrize(
    ('bearing', 'variance', 'message'),
    [
        (np.zeros(5), variances(6), '5 bearings'),
        (np.full(6, np.nan), variances(6), 'not a number'),
        (np.zeros(6), np.zeros(6), 'positive'),
    ],
)
def test_bad_input(bearing, variance, message):
    with pytest.raises(LandmarkNavError, match=message):
        triangulate(LANDMARKS, bearing, variance)


class TestModel:
    def test_gradients_against_differences(self):
        gradients = bearing_gradients(POSE, LANDMARKS)
        for axis, offset in enumerate(1e-6 * np.eye(3)[:2]):
            change = bearings(POSE + offset, LANDMARKS) - bearings(POSE - offset, LANDMARKS)
            np.testing.assert_allclose(gradients[:, axis], wrap_rad(change) / 2e-6, atol=1e-8)

    def test_lever_arm_there_and_back(self):
        mount = PanTiltMount(axis_xyz=(0.3, -0.1, 1.0))
        spread = np.array([[0.02, 0.001, 0.003], [0.001, 0.03, -0.002], [0.003, -0.002, 0.01]])
        base = PoseEstimate(7, np.array([1.0, 2.0, np.pi / 2.0]), spread)
        axis = axis_from_base(base, mount)
        np.testing.assert_allclose(axis.pose, [1.1, 2.3, np.pi / 2.0])
        back = base_from_axis(axis, mount)
        np.testing.assert_allclose(back.pose, base.pose)
        np.testing.assert_allclose(back.covariance, base.covariance, atol=1e-15)
        draws = np.random.default_rng(0).multivariate_normal(base.pose, 1e-4 * spread, 20000)
        moved = draws[:, :2] + np.column_stack(
            [
                0.3 * np.cos(draws[:, 2]) + 0.1 * np.sin(draws[:, 2]),
                0.3 * np.sin(draws[:, 2]) - 0.1 * np.cos(draws[:, 2]),
            ]
        )
        np.testing.assert_allclose(
            np.cov(moved.T), 1e-4 * axis.covariance[:2, :2], atol=1e-7, rtol=0.05
        )


COORDINATE = st.floats(-10.0, 10.0)
TRIPLES = st.tuples(*[COORDINATE] * 6).map(lambda v: np.array(v).reshape(3, 2))
POSES = st.tuples(COORDINATE, COORDINATE, st.floats(-np.pi, np.pi)).map(np.array)


@given(TRIPLES, POSES)
def test_recovers_the_pose(landmarks, pose):
    assume(np.hypot(*(landmarks - pose[:2]).T).min() > 0.3)
    assume(danger_distance(pose[:2], landmarks)[1] > 0.05)
    assume(np.abs(np.linalg.det(np.column_stack([landmarks, np.ones(3)]))) > 0.1)
    found = triangulate_three(landmarks, bearings(pose, landmarks))
    np.testing.assert_allclose(found[:2], pose[:2], atol=1e-8)
    assert abs(wrap_rad(found[2] - pose[2])) < 1e-8
