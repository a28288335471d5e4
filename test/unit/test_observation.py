from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np

from landmark_nav.geometry.patches import observed_well, relative_sampling

POINT = np.array([[2.0, 0.0, 1.2]])
NORMAL = np.array([[0.0, 1.0, 0.0]])


@given(st.floats(0.0, 2.0 * np.pi), st.floats(0.1, 9.0), st.floats(-1.2, 1.2))
def test_area_is_the_annulus_between_two_tangent_circles(
    direction: float, distance: float, incidence: float
) -> None:
    reference = POINT + 3.0 * np.array([[np.sin(incidence), np.cos(incidence), 0.0]])
    viewer = POINT[0] + distance * np.array([np.cos(direction), np.sin(direction), 0.0])

    def inside_tangent_circle(diameter: float) -> bool:
        return bool(np.hypot(viewer[0] - 2.0, viewer[1] - diameter / 2.0) <= diameter / 2.0)

    expected = (
        1.5 <= distance <= 6.0
        and inside_tangent_circle(6.0 / np.cos(incidence))
        and not inside_tangent_circle(1.5 / np.cos(incidence))
    )
    # On the very border rounding decides.
    horizontal, vertical = relative_sampling(POINT, NORMAL, reference, viewer)
    values = np.array([horizontal[0], vertical[0]])
    if np.all(np.abs(values - [[0.5], [2.0]]) > 1e-6):
        assert observed_well(POINT, NORMAL, reference, viewer)[0] == expected
