"""Blur is measured against neighbouring images of the same wall."""

import cv2
import numpy as np
import pytest

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.capture.frames import look_at, relative_sharpness

CAMERA = CameraModel(256, 192, 280.0, 280.0, 127.5, 95.5)
LEVEL = PanTiltMount()
UPSIDE_DOWN = PanTiltMount(axis_rpy=(np.pi, 0.0, 0.0))
STEP = np.radians(5.0)
RAYS = CAMERA.unproject(np.stack(np.meshgrid(np.arange(256.0), np.arange(192.0)), -1))


def texture(rng, blank=0.0):
    """A wall, 1600 px wide, around the turn; the share `blank` of it shows nothing."""
    layers = [
        cv2.resize(rng.normal(0.0, 1.0, (600 // s, 1600 // s)), (1600, 600)) for s in (4, 9, 25)
    ]
    wall = 120.0 + 25.0 * np.sum(layers, axis=0)
    wall[:, : int(blank * 1600)] = 120.0
    return wall.astype(np.float32)


def view(wall, pan, rng, mount=LEVEL, blur=None, gain=1.0):
    """What the camera sees of the wall, on a cylinder of 400 px per radian."""
    rays = RAYS @ mount.camera_pose_base(pan)[0].T
    x = 800.0 - 250.0 * np.arctan2(rays[..., 1], rays[..., 0])
    y = 300.0 - 250.0 * rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
    image = cv2.remap(
        wall,
        x.astype(np.float32),
        y.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )
    if blur is not None:
        image = cv2.filter2D(image, -1, blur)
    image = gain * image + rng.normal(0.0, 2.0, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


GAUSS = cv2.getGaussianKernel(13, 2.0)
BLURS = {
    'defocus': GAUSS @ GAUSS.T,
    'across': np.full((1, 7), 1 / 7),
    'down': np.full((7, 1), 1 / 7),
}


@pytest.mark.parametrize('mount', [LEVEL, UPSIDE_DOWN])
@pytest.mark.parametrize('seed', range(2))
def test_neighbours_are_as_sharp_as_each_other(seed, mount):
    rng = np.random.default_rng(seed)
    wall = texture(rng, blank=0.5)
    for pan in np.radians(np.arange(-120.0, 120.0, 20.0)):
        here = look_at(view(wall, pan, rng, mount, gain=0.8), CAMERA)
        there = look_at(view(wall, pan + STEP, rng, mount), CAMERA)
        # Upside down the camera turns the other way, and the pan is given as the joint has it.
        assert 0.8 < relative_sharpness(here, there, -STEP) < 1.25


@pytest.mark.parametrize('kind', BLURS)
@pytest.mark.parametrize('seed', range(4))
def test_a_blurred_image_is_not(kind, seed):
    rng = np.random.default_rng(seed)
    wall = texture(rng)
    here = look_at(view(wall, 0.3, rng, blur=BLURS[kind]), CAMERA)
    there = look_at(view(wall, 0.3 + STEP, rng), CAMERA)
    assert relative_sharpness(here, there, -STEP) < 0.6


def test_somebody_who_stands_in_a_third_of_the_view_hardly_counts():
    rng = np.random.default_rng(0)
    wall = texture(rng)
    there = look_at(view(wall, STEP, rng), CAMERA)
    camera_image = view(wall, 0.0, rng)
    camera_image[:, 90:170] = 40
    assert relative_sharpness(look_at(camera_image, CAMERA), there, -STEP) > 0.8


def test_blank_images_and_images_of_other_places():
    rng = np.random.default_rng(0)
    blank = look_at(np.full((192, 256, 3), 255, np.uint8), CAMERA)
    assert blank.flat
    assert relative_sharpness(blank, blank, STEP) == pytest.approx(1.0)
    wall = look_at(view(texture(rng), 0.0, rng), CAMERA)
    assert not wall.flat
    assert relative_sharpness(wall, wall, 1.5) is None
