from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np

from landmark_nav.geometry.angles import wrap_rad

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
