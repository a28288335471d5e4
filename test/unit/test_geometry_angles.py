from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np

from landmark_nav.geometry.angles import unwrap_joint, wrap_rad

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


def test_a_joint_that_is_reported_within_half_a_turn_turns_on() -> None:
    stamps_ns = 50_000_000 * np.arange(400)
    true = 2.5 + np.cumsum(np.repeat([0.1, -0.08], 200))
    for way in (slice(None), slice(None, None, -1)):
        found = unwrap_joint(stamps_ns[way], wrap_rad(true)[way])
        np.testing.assert_allclose(found - found[0], true[way] - true[way][0], atol=1e-9)
        assert found[0] == wrap_rad(true)[way][0]


def test_a_joint_that_counts_its_turns_stays_as_it_is() -> None:
    pans = np.array([18.7, 18.9, 24.0, 31.0, 18.0])
    stamps_ns = np.array([0, 50_000_000, 600_000_000, 1_400_000_000, 3_000_000_000])
    np.testing.assert_array_equal(unwrap_joint(stamps_ns, pans), pans)
