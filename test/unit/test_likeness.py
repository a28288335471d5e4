"""Displacement of parts of a patch between two views."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from landmark_nav.arrays import Float32Array
from landmark_nav.learning.stereo.wall_stereo import displaced_quarter


def texture(seed: int) -> Float32Array:
    noise = np.random.default_rng(seed).normal(size=(60, 60))
    blots = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.asarray(120.0 + 30.0 * blots / blots.std(), dtype=np.float32)


def noisy(image: Float32Array, sigma: float, seed: int) -> Float32Array:
    noise = np.random.default_rng(seed).normal(0.0, sigma, image.shape)
    return np.asarray(image + noise, dtype=np.float32)


@pytest.mark.parametrize('sigma', [0.5, 2.0])
def test_noise_gain_and_offset_displace_nothing(sigma: float) -> None:
    for seed in range(10):
        view = texture(seed)[10:41, 10:44]
        # One half is blank: no place shows there, and noise alone must not count as one.
        view[:, 20:] = 100.0
        other = noisy(0.8 * view + 20.0, sigma, seed + 50)
        assert displaced_quarter(noisy(view, sigma, seed), other) < 0.35


@pytest.mark.parametrize('shift', [0.5, 1.0])
def test_the_displacement_of_a_quarter_is_measured(shift: float) -> None:
    for seed in range(10):
        whole = texture(seed)
        moved = cv2.warpAffine(whole, np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0]]), (60, 60))
        view, other = whole[10:42, 10:42], whole[10:42, 10:42].copy()
        other[:16, :16] = moved[10:26, 10:26]
        # Gradients point in all directions: along half of them nothing shifts.
        found = displaced_quarter(noisy(view, 1.0, seed), noisy(other, 1.0, seed + 50))
        assert found == pytest.approx(shift * 0.5**0.5, rel=0.25)


def test_another_texture_in_one_quarter_is_far_out_of_place() -> None:
    for seed in range(10):
        view = texture(seed)[10:42, 10:42]
        other = view.copy()
        other[16:, 16:] = texture(seed + 100)[10:26, 10:26]
        assert displaced_quarter(view, other) > 1.5
