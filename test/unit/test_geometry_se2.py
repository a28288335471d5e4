from __future__ import annotations

from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st
import numpy as np

from landmark_nav.arrays import FloatArray
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad

POSES = st.tuples(*[st.floats(-50.0, 50.0)] * 2, st.floats(-10.0, 10.0)).map(np.array)


def matrix(pose: FloatArray) -> FloatArray:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[cos, -sin, pose[0]], [sin, cos, pose[1]], [0.0, 0.0, 1.0]])


def differences(function: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    """Central differences of poses by poses, (3, 3)."""
    step = 1e-6
    columns = []
    for k in range(3):
        offset = np.zeros(3)
        offset[k] = step
        change = function(at + offset) - function(at - offset)
        change[2] = wrap_rad(change[2])
        columns.append(change / (2.0 * step))
    return np.stack(columns, -1)


@given(POSES, POSES)
def test_compose_is_the_product_of_matrices(first: FloatArray, second: FloatArray) -> None:
    np.testing.assert_allclose(
        matrix(se2.compose(first, second)), matrix(first) @ matrix(second), atol=1e-9
    )


@given(POSES)
def test_inverse_is_the_inverse_matrix(pose: FloatArray) -> None:
    np.testing.assert_allclose(matrix(se2.inverse(pose)) @ matrix(pose), np.eye(3), atol=1e-9)


@given(POSES, POSES)
def test_relative_undoes_compose(first: FloatArray, second: FloatArray) -> None:
    found = se2.relative(first, se2.compose(first, second))
    np.testing.assert_allclose(matrix(found), matrix(second), atol=1e-9)


@given(POSES, POSES)
def test_headings_are_wrapped(first: FloatArray, second: FloatArray) -> None:
    for pose in (se2.compose(first, second), se2.inverse(first), se2.relative(first, second)):
        assert -np.pi < pose[2] <= np.pi


@given(POSES, POSES)
def test_jacobians_agree_with_differences(first: FloatArray, second: FloatArray) -> None:
    by_first, by_second = se2.compose_jacobians(first, second)
    numeric_first = differences(lambda pose: se2.compose(pose, second), first)
    numeric_second = differences(lambda pose: se2.compose(first, pose), second)
    np.testing.assert_allclose(by_first, numeric_first, atol=1e-6)
    np.testing.assert_allclose(by_second, numeric_second, atol=1e-6)


@given(POSES, st.lists(st.tuples(*[st.floats(-50.0, 50.0)] * 2), min_size=1, max_size=4))
def test_points_move_with_the_frame(pose: FloatArray, points: list[tuple[float, float]]) -> None:
    moved = se2.transform_points(pose, points)
    homogeneous = np.c_[np.array(points), np.ones(len(points))]
    np.testing.assert_allclose(moved, (homogeneous @ matrix(pose).T)[:, :2], atol=1e-9)


def test_many_poses_at_once_equal_one_by_one() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.normal(size=(2, 4, 5, 3))
    together = se2.compose(first, second)
    for k in np.ndindex(4, 5):
        np.testing.assert_allclose(together[k], se2.compose(first[k], second[k]))
    np.testing.assert_allclose(
        se2.compose(first[0, 0], second)[2, 3], se2.compose(first[0, 0], second[2, 3])
    )


@given(POSES, st.lists(st.floats(-3.1, 3.1), min_size=1, max_size=4), st.floats(0.1, 50.0))
def test_bearings_are_those_at_which_points_were_put(
    pose: FloatArray, angles: list[float], away: float
) -> None:
    ahead = away * np.column_stack([np.cos(angles), np.sin(angles)])
    found = se2.bearings(pose, se2.transform_points(pose, ahead))
    np.testing.assert_allclose(found, angles, atol=1e-9)
