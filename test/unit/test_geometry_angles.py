from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.geometry.angles import circular_mean_rad, wrap_rad

ANGLES = st.floats(-1e3, 1e3)


@given(ANGLES)
def test_wrapped_angle_has_the_same_direction_and_lies_in_one_turn(angle: float) -> None:
    wrapped = wrap_rad(angle)
    assert -np.pi < wrapped <= np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-9)


def test_the_half_turn_is_positive() -> None:
    np.testing.assert_array_equal(wrap_rad([np.pi, -np.pi]), [np.pi, np.pi])


def test_shape_is_kept() -> None:
    assert wrap_rad(np.zeros((2, 3, 4))).shape == (2, 3, 4)


@given(ANGLES, st.floats(0.0, 1.5))
def test_mean_of_two_lies_in_the_middle_across_the_seam(center: float, spread: float) -> None:
    mean = circular_mean_rad([center - spread, center + spread])
    assert abs(wrap_rad(mean - center)) < 1e-9


def test_weights_pull_the_mean() -> None:
    # tan of the mean is (3 sin 0.2) / (1 + 3 cos 0.2) by definition.
    expected = np.arctan2(3.0 * np.sin(0.2), 1.0 + 3.0 * np.cos(0.2))
    assert circular_mean_rad([0.0, 0.2], [1.0, 3.0]) == pytest.approx(expected)
