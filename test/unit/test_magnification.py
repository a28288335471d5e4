from __future__ import annotations

import cv2
import numpy as np
import pytest
from scenes import smooth_texture

from landmark_nav.arrays import Float32Array
from landmark_nav.learning.stereo.magnification import log_magnification, MARGIN

SIZE = 28 + 2 * MARGIN


def two_views(
    rng: np.random.Generator, larger: float, *, blur: float = 0.0
) -> tuple[Float32Array, Float32Array]:
    """A pattern, and the same a little beside and `larger`, darker and blurred."""
    texture = smooth_texture(rng, 1.0, 1.0, 0.04)
    # Finer than the views: OpenCV knows 32 steps a pixel.
    wide = cv2.resize(texture[..., 0], None, fx=4.0, fy=4.0, interpolation=cv2.INTER_CUBIC)
    middle = 0.5 * (np.array(wide.shape[::-1]) - 1.0)
    side = wide.shape[1] / 100.0
    views = []
    for scale, shift in ((1.0, 0.0), (larger, 0.3)):
        grid = side * (np.arange(SIZE) - 0.5 * (SIZE - 1) - shift) / scale
        columns, rows = np.meshgrid(grid + middle[0], grid + middle[1])
        soft = cv2.GaussianBlur(wide, (0, 0), side)
        views.append(
            cv2.remap(soft, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_CUBIC)
        )
    if blur:
        views[1] = cv2.GaussianBlur(views[1], (0, 0), blur)
    return views[0], 0.8 * views[1] + 10.0


@pytest.mark.parametrize('larger', [0.9, 0.97, 1.0, 1.03, 1.12])
def test_how_much_larger_a_view_shows_a_pattern_is_recovered(larger: float) -> None:
    for seed in range(5):
        template, found = two_views(np.random.default_rng(seed), larger)
        reported = log_magnification(template, found, 1.0)
        assert reported is not None
        assert reported[0] == pytest.approx(np.log(larger), rel=0.05, abs=1e-3)


def test_its_sigma_is_that_of_the_noise() -> None:
    rng = np.random.default_rng(3)
    normalized = []
    for seed in range(100):
        template, found = two_views(np.random.default_rng(seed), 1.02)
        found = found + rng.normal(0.0, 3.0, found.shape).astype(np.float32)
        reported = log_magnification(template, found, 1.0)
        assert reported is not None
        normalized.append((reported[0] - np.log(1.02)) / reported[1])
    assert 0.8 < np.sqrt(np.mean(np.square(normalized))) < 1.25


def test_what_has_no_pattern_gives_nothing() -> None:
    flat = np.full((SIZE, SIZE), 90.0, np.float32)
    assert log_magnification(flat, flat, 1.0) is None
    # Stripes grow across alone, and would from any depth.
    stripes = flat + np.float32(30.0) * np.sin(np.arange(SIZE, dtype=np.float32))
    assert log_magnification(stripes, stripes, 1.0) is None
    noise = np.random.default_rng(0).normal(90.0, 3.0, (2, SIZE, SIZE)).astype(np.float32)
    assert log_magnification(noise[0], noise[1], 1.0) is None
