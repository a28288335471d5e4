"""Exposures and vignetting are estimated from overlaps and corrected."""

from dataclasses import replace

import numpy as np
import pytest
from turning_camera import turn_sweep

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
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


@pytest.mark.parametrize('light', [0.15, 0.4])
def test_a_sweep_in_the_dark_is_brightened_as_a_whole(even, light):
    usual = taken(even, np.ones(len(PANS)), 0.0, noise=0.5)
    dark = taken(even, np.full(len(PANS), light), 0.0, noise=0.5)
    found = measure_photometry(dark, MOUNT)
    assert found.gain_spread == 0.0
    assert found.exposure < 1.0
    mended = np.array([frame.image for frame in even_out(dark, found).frames])
    assert 110.0 < np.quantile(mended, 0.9) < 130.0
    likeness = np.corrcoef(mended[3].ravel(), usual.frames[3].image.ravel())[0, 1]
    assert likeness > 0.99


def test_what_is_even_or_black_is_left_alone(even):
    black = tuple(replace(f, image=np.zeros_like(f.image)) for f in even.frames)
    for sweep in (taken(even, np.ones(len(PANS)), 0.0), replace(even, frames=black)):
        assert even_out(sweep, measure_photometry(sweep, MOUNT)) is sweep
