"""Exposures and vignetting are estimated from overlaps and corrected."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from turning_camera import turn_sweep

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.capture.frames import look_at, relative_sharpness
from landmark_nav.learning.panorama.photometry import even_out, measure_photometry

MOUNT = PanTiltMount()
CAMERA = CameraModel(240, 200, 230.0, 230.0, 112.0, 101.0)
PANS = -np.pi + np.radians(12.0) * np.arange(30)


@pytest.fixture(scope='module')
def even():
    return turn_sweep(CAMERA, MOUNT, PANS)


def test_frames_that_do_not_overlap_keep_their_exposure(even):
    """As by a sweep whose angles are not those of its frames: three parts far from each other."""
    kept = tuple(even.frames[k] for k in (0, 1, 10, 11, 20, 21))
    found = measure_photometry(replace(even, frames=kept), MOUNT)
    assert found.gain == pytest.approx(1.0, abs=0.02)


def taken(sweep, gains, vignetting, noise=2.0):
    """The same with exposures, light lost in the corners as 1 - v r^2, and noise."""
    rng = np.random.default_rng(3)
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    square = (u - CAMERA.cx) ** 2 + (v - CAMERA.cy) ** 2
    falloff = (1.0 - vignetting * square / square.max())[..., None]
    frames = []
    for frame, gain in zip(sweep.frames, gains, strict=True):
        grey = 0.6 * frame.image * falloff * gain + rng.normal(0.0, noise, frame.image.shape)
        frames.append(replace(frame, image=np.clip(np.rint(grey), 0, 255).astype(np.uint8)))
    return replace(sweep, frames=tuple(frames))


def test_exposures_and_vignetting_are_recovered(even):
    gains = np.exp(np.random.default_rng(1).normal(0.0, 0.08, len(PANS)))
    sweep = taken(even, gains, 0.3)
    found = measure_photometry(sweep, MOUNT)
    assert found.vignetting == pytest.approx(0.3, abs=0.02)
    np.testing.assert_allclose(found.gain, gains / np.exp(np.log(gains).mean()), atol=0.02)
    mended = even_out(sweep, found)
    scale = np.exp(np.log(gains).mean())
    for k in (0, 7, 20):
        corner = (slice(0, 40), slice(0, 40))
        ratio = mended.frames[k].image[corner].mean() / even.frames[k].image[corner].mean()
        assert ratio == pytest.approx(0.6 * scale, rel=0.04)


def test_grey_frames_and_exposures_alone(even):
    gains = np.where(np.arange(len(PANS)) == 4, 0.8, 1.0)
    sweep = taken(even, gains, 0.0)
    grey = replace(sweep, frames=tuple(replace(f, image=f.image[..., 0]) for f in sweep.frames))
    found = measure_photometry(grey, MOUNT)
    assert found.gain[4] == pytest.approx(0.8, abs=0.02)
    assert found.vignetting == 0.0
    assert even_out(grey, found).frames[4].image.ndim == 2


def test_what_is_even_or_black_is_left_alone(even):
    black = tuple(replace(f, image=np.zeros_like(f.image)) for f in even.frames)
    for sweep in (taken(even, np.ones(len(PANS)), 0.0), replace(even, frames=black)):
        assert even_out(sweep, measure_photometry(sweep, MOUNT)) is sweep


LENS = CameraModel(256, 192, 280.0, 280.0, 127.5, 95.5)
LEVEL = PanTiltMount()
UPSIDE_DOWN = PanTiltMount(axis_rpy=(np.pi, 0.0, 0.0))
STEP = np.radians(5.0)
RAYS = LENS.unproject(np.stack(np.meshgrid(np.arange(256.0), np.arange(192.0)), -1))


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
        here = look_at(view(wall, pan, rng, mount, gain=0.8), LENS)
        there = look_at(view(wall, pan + STEP, rng, mount), LENS)
        # Upside down the camera turns the other way, and the pan is given as the joint has it.
        assert 0.8 < relative_sharpness(here, there, -STEP) < 1.25


@pytest.mark.parametrize('kind', BLURS)
@pytest.mark.parametrize('seed', range(4))
def test_a_blurred_image_is_not(kind, seed):
    rng = np.random.default_rng(seed)
    wall = texture(rng)
    here = look_at(view(wall, 0.3, rng, blur=BLURS[kind]), LENS)
    there = look_at(view(wall, 0.3 + STEP, rng), LENS)
    assert relative_sharpness(here, there, -STEP) < 0.6


def test_somebody_who_stands_in_a_third_of_the_view_hardly_counts():
    rng = np.random.default_rng(0)
    wall = texture(rng)
    there = look_at(view(wall, STEP, rng), LENS)
    camera_image = view(wall, 0.0, rng)
    camera_image[:, 90:170] = 40
    assert relative_sharpness(look_at(camera_image, LENS), there, -STEP) > 0.8


def test_blank_images_and_images_of_other_places():
    rng = np.random.default_rng(0)
    blank = look_at(np.full((192, 256, 3), 255, np.uint8), LENS)
    assert blank.flat
    assert relative_sharpness(blank, blank, STEP) == pytest.approx(1.0)
    wall = look_at(view(texture(rng), 0.0, rng), LENS)
    assert not wall.flat
    assert relative_sharpness(wall, wall, 1.5) is None
