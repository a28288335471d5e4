from __future__ import annotations

from typing import Any

import cv2
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.se2 import rotation_rpy

SIZE: dict[str, Any] = {
    'width': 512, 'height': 384, 'fx': 570.0, 'fy': 572.0, 'cx': 254.0, 'cy': 193.5,
}  # fmt: skip
CAMERAS = {
    'ideal': CameraModel(**SIZE),
    'plumb_bob': CameraModel(
        **SIZE, model='plumb_bob', distortion=(-0.21, 0.06, 0.001, -0.0007, 0.01)
    ),
    'rational_polynomial': CameraModel(
        **SIZE,
        model='rational_polynomial',
        distortion=(0.4, -0.1, 0.0005, 0.0002, 0.02, 0.7, -0.05, 0.01),
    ),
    'equidistant': CameraModel(
        **{**SIZE, 'fx': 230.0, 'fy': 231.0},
        model='equidistant',
        distortion=(-0.02, 0.005, -0.003, 0.0004),
    ),
}


@pytest.mark.parametrize('camera', CAMERAS.values(), ids=CAMERAS.keys())
@settings(max_examples=30)
@given(st.floats(-0.5, 511.5), st.floats(-0.5, 383.5))
def test_every_pixel_comes_back(camera, u, v):
    ray = camera.unproject([u, v])
    assert ray[2] == 1.0
    np.testing.assert_allclose(camera.project(7.0 * ray), [u, v], atol=1e-6)


@pytest.mark.parametrize('camera', CAMERAS.values(), ids=CAMERAS.keys())
def test_what_is_behind_or_folds_back_has_no_pixel(camera):
    pixels = camera.project([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [30.0, 0.0, 1.0]])
    assert np.isnan(pixels).all()


def test_contains_respects_the_margin():
    pixels = [[5.0, 5.0], [0.0, 0.0], [511.0, 383.0], [512.0, 10.0], [np.nan, 3.0]]
    camera = CAMERAS['ideal']
    assert camera.contains(pixels).tolist() == [True, True, True, False, False]
    assert camera.contains(pixels, 5.0).tolist() == [True, False, False, False, False]


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'model': 'fov'}, "'fov' is not supported: publish camera_info as one of equidistant"),
        ({'distortion': (0.1,) * 13}, 'takes 12 distortion coefficients at most'),
        ({'fx': 0.0}, 'not a calibrated camera'),
        ({'cx': float('nan')}, 'not a calibrated camera'),
        ({'width': 0}, '0 x 384 image'),
        ({'distortion': (-1.5,)}, 'folds back'),
        ({'distortion': (0, 0, 0, 3)}, 'folds back'),
        ({'distortion': (0, 0, 1e308, 0)}, 'folds back'),
        ({'distortion': (0,) * 8 + (30.0, 0, 0, 0)}, 'folds back'),
        ({'fx': 1.0, 'fy': 1.0}, 'deg wide'),
        ({'fx': 57000.0, 'fy': 57000.0}, 'to one side'),
        ({'cx': 1e6}, 'outside of the image'),
        ({'cy': -1e6}, 'outside of the image'),
        ({'distortion': (1e300, 0, 0, 0, 0, -1e300)}, 'folds back'),
    ],
)
def test_what_is_no_camera_is_refused(change, message):
    with pytest.raises(LandmarkNavError, match=message):
        CameraModel(**{**SIZE, **change})


def test_a_lens_that_folds_back_in_the_corners_is_used_inside_of_that():
    camera = CameraModel(**SIZE, distortion=(-0.7,))
    assert 'folds back' in camera.restriction
    rng = np.random.default_rng(0)
    pixels = rng.uniform(-0.5, [511.5, 383.5], (2000, 2))
    rays = camera.unproject(pixels)
    assert np.isfinite(rays).all()
    assert np.isfinite(camera.ray_grid).all()
    back = camera.project(rays * [0.999, 0.999, 1.0])
    inside = np.linalg.norm((pixels - [254.0, 193.5]) / [570.0, 572.0], axis=1) < 0.44
    assert 0.7 < inside.mean() < 1.0
    np.testing.assert_allclose(camera.project(rays[inside]), pixels[inside], atol=1e-6)
    # No ray comes back to a pixel beyond the fold.
    assert np.linalg.norm(np.nan_to_num(back) - [254.0, 193.5], axis=1).max() < 0.51 * 570.0


@pytest.mark.parametrize('shift', [0.05, 0.1, 0.13])
def test_a_tangential_fold_is_one_too(shift):
    camera = CameraModel(**SIZE, distortion=(0.0, 0.0, shift, -shift))
    rays = camera.unproject(np.random.default_rng(0).uniform(-0.5, [511.5, 383.5], (500, 2)))
    back = camera.project(rays)
    seen = np.isfinite(back).all(axis=1)
    assert seen.mean() > 0.4
    np.testing.assert_allclose(camera.unproject(back[seen]), rays[seen], atol=1e-3)
    assert bool(camera.restriction) == (shift > 0.1)


@pytest.mark.parametrize('distortion', [(0.9,), (3.0,), (-0.3, 0.1, 0.02, -0.02), (0.0,) * 5])
@pytest.mark.parametrize('prism', [(), (0.0, 0.0, 0.0, 0.01, 0.002, -0.02, 0.003)])
def test_strong_lenses_and_thin_prisms_invert(distortion, prism):
    lens = (*distortion, *[0.0] * (5 - len(distortion)), *prism)
    camera = CameraModel(**SIZE, distortion=lens)
    pixels = np.random.default_rng(1).uniform(-0.5, [511.5, 383.5], (500, 2))
    rays = camera.unproject(pixels)
    np.testing.assert_allclose(camera.project(rays), pixels, atol=1e-6)
    expected, _ = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), camera.matrix, camera.coefficients
    )
    np.testing.assert_allclose(expected[:, 0], pixels, atol=1e-6)


@pytest.mark.parametrize('size', [(256, 192), (171, 128), (1024, 768)])
def test_a_resized_camera_sees_the_same_rays(size):
    camera = CAMERAS['plumb_bob']
    resized = camera.resized(*size)
    points = camera.unproject(np.random.default_rng(2).uniform(0.0, [511.0, 383.0], (50, 2)))
    np.testing.assert_allclose(
        resized.in_full_image(resized.project(points)), camera.project(points), atol=1e-6
    )


def test_rpy_turns_about_fixed_axes_roll_first():
    np.testing.assert_allclose(rotation_rpy([0, 0, np.pi / 2]) @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(rotation_rpy([0, np.pi / 2, 0]) @ [1, 0, 0], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(
        rotation_rpy([np.pi / 2, 0, np.pi / 2]) @ [0, 1, 0], [0, 0, 1], atol=1e-15
    )


def test_at_zero_the_camera_looks_ahead():
    rotation, center = PanTiltMount(axis_xyz=(0.1, 0.2, 1.1)).camera_pose_base(0.0)
    np.testing.assert_allclose(rotation @ [0, 0, 1], [1, 0, 0], atol=1e-15)  # forward
    np.testing.assert_allclose(rotation @ [1, 0, 0], [0, -1, 0], atol=1e-15)  # image right
    np.testing.assert_allclose(rotation @ [0, 1, 0], [0, 0, -1], atol=1e-15)  # image down
    np.testing.assert_allclose(center, [0.1, 0.2, 1.1])


def test_pan_is_to_the_left_and_tilt_upwards():
    mount = PanTiltMount()
    left, _ = mount.camera_pose_base(np.pi / 2)
    np.testing.assert_allclose(left @ [0, 0, 1], [0, 1, 0], atol=1e-15)
    up, _ = mount.camera_pose_base(0.0, np.pi / 6)
    np.testing.assert_allclose(up @ [0, 0, 1], [np.cos(np.pi / 6), 0, 0.5], atol=1e-15)


@pytest.mark.parametrize('roll_rad', [0.0, np.pi])
@pytest.mark.parametrize('pitch_rad', [0.0, np.pi, 0.02])
@given(yaw_rad=st.floats(-3.0, 3.0), pan_rad=st.floats(-3.0, 3.0))
def test_a_pan_looks_at_its_azimuth_however_the_unit_is_mounted(
    roll_rad, pitch_rad, yaw_rad, pan_rad
):
    mount = PanTiltMount(axis_rpy=(roll_rad, pitch_rad, yaw_rad))
    x, y, _ = mount.camera_pose_base(pan_rad)[0][:, 2]
    azimuth = mount.azimuth_base_rad(pan_rad)
    assert abs(wrap_rad(np.arctan2(y, x) - azimuth)) < 1e-3
    assert mount.pan_toward_rad(azimuth) == pytest.approx(pan_rad, abs=1e-9)
