"""Corrections are published without jumps, and completely within their time."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import compose
from landmark_nav.localization.expected_poses import SpreadCorrection

SECOND_NS = 1_000_000_000
angles = st.floats(-np.pi, np.pi)
places = st.floats(-50.0, 50.0)
poses = st.tuples(places, places, angles).map(np.array)
small = st.tuples(*3 * [st.floats(-0.3, 0.3)]).map(np.array)


@given(fused=poses, odometry=poses)
def test_without_a_time_all_of_it_comes_at_once(fused: np.ndarray, odometry: np.ndarray) -> None:
    spread = SpreadCorrection(0.0)
    for stamp_ns, pose in enumerate((fused, fused + np.array([1.0, 2.0, 0.5]))):
        error = compose(spread.at(stamp_ns, pose, odometry), odometry) - pose
        assert np.abs([*error[:2], wrap_rad(error[2])]).max() < 1e-9


@given(fused=poses, odometry=poses, correction=small)
def test_a_correction_decays_at_the_base_wherever_odom_begins(
    fused: np.ndarray, odometry: np.ndarray, correction: np.ndarray
) -> None:
    spread = SpreadCorrection(2.0)
    spread.at(0, fused, odometry)
    for k in range(1, 9):
        shown = compose(spread.at(k * SECOND_NS // 2, fused + correction, odometry), odometry)
        error = fused + correction - shown
        error[2] = wrap_rad(error[2])
        np.testing.assert_allclose(error, correction * np.exp(-0.25 * k), atol=1e-9)


def test_the_way_between_is_followed_without_lag() -> None:
    spread = SpreadCorrection(5.0)
    offset = np.array([3.0, -1.0, 0.7])
    for k in range(20):
        odometry = np.array([0.1 * k, 0.02 * k, 0.05 * k])
        shown = spread.at(k * SECOND_NS // 10, compose(offset, odometry), odometry)
        np.testing.assert_allclose(shown, offset, atol=1e-9)


def test_a_new_start_and_a_clock_set_back_are_not_spread() -> None:
    spread = SpreadCorrection(5.0)
    here, there, odometry = np.zeros(3), np.array([4.0, 2.0, 1.0]), np.array([1.0, 1.0, 0.3])
    spread.at(10 * SECOND_NS, here, odometry)
    np.testing.assert_allclose(compose(spread.at(SECOND_NS, there, odometry), odometry), there)
    spread.restart()
    shown = compose(spread.at(2 * SECOND_NS, here, odometry), odometry)
    np.testing.assert_allclose(shown, here, atol=1e-12)
