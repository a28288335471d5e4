from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
import numpy as np

from landmark_nav.geometry.patches import patch_axes, rays_to_patch
from landmark_nav.geometry.se2 import rotation_rpy

BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@given(
    azimuth=st.floats(-np.pi, np.pi),
    off=st.floats(-1.2, 1.2),
    reach=st.floats(0.4, 9.0),
    rpy=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.5, 0.5)),
    ray=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
)
def test_rays_meet_the_patch_where_the_plane_states(
    azimuth: float,
    off: float,
    reach: float,
    rpy: tuple[float, float, float],
    ray: tuple[float, float],
) -> None:
    normal = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    position = np.array([2.0, -3.0, 1.4])
    direction = np.array([np.cos(azimuth + off), np.sin(azimuth + off), 0.05])
    center = position + reach * direction
    facing = rotation_rpy([0.0, 0.0, azimuth + off + np.pi]) @ rotation_rpy(rpy)
    rotation = facing @ BODY_FROM_OPTICAL
    # Metres on the patch, by meeting of ray and plane.
    out = rotation @ np.array([*ray, 1.0])
    if out @ normal > -0.05:
        return  # along the wall, or away from it
    point = center + ((position - center) @ normal) / (out @ normal) * out
    right, down = patch_axes(normal)
    expected = np.array([(point - position) @ right, (point - position) @ down])

    homography = rays_to_patch(position[None], normal[None], rotation, center)[0]
    found = homography @ np.array([*ray, 1.0])
    np.testing.assert_allclose(found[:2] / found[2], expected, rtol=1e-8, atol=1e-9)
    # In front of the camera the scale is positive: what lies behind is distinguished by its sign.
    assert found[2] > 0.0
