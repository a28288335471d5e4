from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.cylinder import Cylinder

CYLINDER = Cylinder(width=3600, height=350, fy=573.0, cx=1799.5, cy=170.0)
COLUMNS = st.floats(-0.5, 3599.499)
ROWS = st.floats(-0.5, 349.5)


@given(COLUMNS, ROWS)
def test_every_pixel_comes_back(column: float, row: float) -> None:
    found = CYLINDER.project(CYLINDER.rays([column, row]))
    # A column within rounding of the seam may come back on its other side.
    gap = (found[0] - column + 1800.0) % 3600.0 - 1800.0
    assert abs(gap) < 1e-8
    assert found[1] == pytest.approx(row, abs=1e-8)


@given(st.floats(-20.0, 20.0))
def test_every_azimuth_comes_back(azimuth: float) -> None:
    column = CYLINDER.column_of(azimuth)
    assert -0.5 <= column < 3599.5
    assert abs(wrap_rad(CYLINDER.azimuth_rad(column) - azimuth)) < 1e-9


def test_left_is_left_and_up_is_up() -> None:
    assert CYLINDER.column_of(0.0) == 1799.5
    assert CYLINDER.column_of(0.1) < 1799.5
    assert CYLINDER.row_of(0.1) < CYLINDER.row_of(0.0) == 170.0


def test_both_sides_of_the_seam_are_neighbours() -> None:
    left, right = CYLINDER.azimuth_rad([-0.5, 3599.5])
    assert left - right == pytest.approx(2.0 * np.pi)
    np.testing.assert_allclose(CYLINDER.wrap_column([3600.0, -1.0, 3599.5]), [0.0, 3599.0, -0.5])


def test_height_over_distance_sets_the_row() -> None:
    column, row = CYLINDER.project([3.0, 4.0, 1.0])
    assert column == pytest.approx(1799.5 - np.arctan2(4.0, 3.0) * 3600 / (2 * np.pi))
    assert row == pytest.approx(170.0 - 573.0 / 5.0)


@given(st.floats(100.0, 1000.0), st.floats(-1.0, -0.05), st.floats(0.05, 1.0))
def test_resolution_and_extent_as_asked(px_per_rad: float, low: float, high: float) -> None:
    cylinder = Cylinder.with_resolution(px_per_rad, low, high)
    assert cylinder.fx == cylinder.fy == pytest.approx(px_per_rad, rel=0.002)
    assert cylinder.tangent(0) >= high - 1e-9
    assert cylinder.tangent(cylinder.height - 1) <= low + 1e-9


@pytest.mark.parametrize(('low', 'high'), [(-1e9, 5.0), (-np.inf, np.inf), (0.0, 1e300)])
def test_rows_end_before_the_poles(low: float, high: float) -> None:
    cylinder = Cylinder.with_resolution(500.0, low, high)
    assert cylinder.width * cylinder.height < 7e6


@pytest.mark.parametrize('px_per_rad', [1e4, 1e300, np.nan])
def test_a_cylinder_too_large_to_hold_is_refused(px_per_rad: float) -> None:
    with pytest.raises(LandmarkNavError, match='million pixels'):
        Cylinder.with_resolution(px_per_rad, -0.5, 0.5)
