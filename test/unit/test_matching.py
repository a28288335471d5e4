from __future__ import annotations

import cv2
import numpy as np
import pytest

from landmark_nav.arrays import Float32Array
from landmark_nav.matching import blur_to, Match, match_template
from landmark_nav.matching.alignment import align
from landmark_nav.simulation.surfaces import light_of, values_of
from landmark_nav.types import FloatArray, ImageArray, Refusal


class Texture:
    """A random continuous texture: waves, so that it can be sampled exactly anywhere."""

    def __init__(self, seed: int, deviation: float = 40.0, shortest_px: float = 5.0) -> None:
        rng = np.random.default_rng(seed)
        length = rng.uniform(shortest_px, 6 * shortest_px, 60)
        angle = rng.uniform(0.0, 2.0 * np.pi, 60)
        turn = 2.0 * np.pi / length
        self._kx, self._ky = turn * np.cos(angle), turn * np.sin(angle)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 60)
        self._amplitude = deviation * np.sqrt(2.0 / 60)

    def sample(self, columns: int, rows: int, x0: float = 0.0, y0: float = 0.0) -> Float32Array:
        # Each wave is a product of one along x and one along y.
        x = np.exp(1j * np.outer(self._kx, x0 + np.arange(columns)))
        y = np.exp(1j * (np.outer(self._ky, y0 + np.arange(rows)) + self._phase[:, None]))
        return (128.0 + self._amplitude * np.einsum('ky,kx->yx', y, x).real).astype(np.float32)


def match_shifted(
    seed: int, noise: float, shortest_px: float = 5.0
) -> tuple[FloatArray, Match | Refusal]:
    """Error of a match at a random shift; the search image has noise, gain and offset."""
    rng = np.random.default_rng([seed, 1])
    texture = Texture(seed, shortest_px=shortest_px)
    shift = rng.uniform(8.0, 16.0, 2)
    template = texture.sample(32, 28, *shift)
    search = 0.8 * texture.sample(56, 52) + 12.0
    search = (search + noise * rng.standard_normal(search.shape)).astype(np.float32)
    found = match_template(search, template)
    truth = shift + np.array([15.5, 13.5])
    return found.xy - truth if isinstance(found, Match) else truth * np.nan, found


def test_a_sub_pixel_shift_is_recovered_without_noise() -> None:
    errors = np.array([match_shifted(seed, 0.0)[0] for seed in range(60)])
    assert np.abs(errors).max() < 0.03
    assert np.abs(errors.mean(axis=0)).max() < 0.01


@pytest.mark.parametrize('noise', [20.0, 35.0])
@pytest.mark.parametrize('shortest_px', [3.0, 5.0, 10.0])
def test_noise_moves_matches_as_far_as_their_covariance_states(
    noise: float, shortest_px: float
) -> None:
    # Fine texture and coarse.
    trials = [match_shifted(seed, noise, shortest_px) for seed in range(150)]
    errors = np.array([error for error, _ in trials])
    assert np.isfinite(errors).all()
    assert np.abs(errors.mean(axis=0)).max() < 3.0 * errors.std() / np.sqrt(len(errors)) + 0.005
    nees = [
        error @ np.linalg.solve(found.covariance, error)
        for error, found in trials
        if isinstance(found, Match)
    ]
    # The mean of 300 squares is within 0.25 of 1 in 99.8 of 100 cases.
    assert 0.75 < np.mean(nees) / 2.0 < 1.25


@pytest.mark.parametrize('out_of_place_px', [0.3, 0.8])
def test_parts_of_a_patch_that_are_out_of_place_count_as_far_as_they_are(
    out_of_place_px: float,
) -> None:
    # As those of an image and its frame are, which do not hang equally far from the wall.
    squares = []
    for seed in range(150):
        rng = np.random.default_rng([seed, 3])
        texture = Texture(seed)
        search = texture.sample(56, 52)
        search += 2.0 * rng.standard_normal(search.shape).astype(np.float32)
        for row in range(12, 40, 7):
            for column in range(12, 44, 8):
                x = column + out_of_place_px * rng.standard_normal()
                search[row : row + 7, column : column + 8] = texture.sample(8, 7, x, row)
        found = match_template(search, texture.sample(32, 28, 12.0, 12.0), min_score=0.5)
        assert isinstance(found, Match)
        squares.append((found.xy[0] - 27.5) ** 2 / found.covariance[0, 0])
    # 8 and 12, were it white noise.
    assert 0.6 < np.mean(squares) < 1.5


def test_gain_and_offset_change_neither_place_nor_score() -> None:
    texture = Texture(3)
    template, search = texture.sample(30, 30, 9.3, 11.6), texture.sample(60, 60)
    plain = match_template(search, template)
    changed = match_template(0.4 * search + 70.0, template)
    assert isinstance(plain, Match)
    assert isinstance(changed, Match)
    np.testing.assert_allclose(changed.xy, plain.xy, atol=2e-3)
    assert changed.score == pytest.approx(plain.score, abs=1e-3)
    assert plain.score > 0.99


_FLAT = np.full((60, 60), 99.0, np.float32)
_REPEATED = np.tile(Texture(8).sample(24, 30), (1, 3))


@pytest.mark.parametrize(
    ('search', 'template', 'reason'),
    [
        (Texture(4).sample(60, 60), _FLAT[:30, :30], 'blank template'),
        (_FLAT, Texture(4).sample(30, 30), ''),
        (Texture(5).sample(60, 60), Texture(6).sample(30, 30), 'low correlation'),
        (Texture(7).sample(60, 60), Texture(7).sample(30, 30, -0.4, 14.0), 'border'),
        (Texture(7).sample(60, 60), Texture(7).sample(30, 30, 30.0, 14.0), 'border'),
        (_REPEATED, _REPEATED[2:28, 12:40].copy(), 'ambiguous'),
    ],
)
def test_a_template_without_one_clear_place_is_refused(
    search: Float32Array, template: Float32Array, reason: str
) -> None:
    found = match_template(search, template)
    assert isinstance(found, Refusal)
    assert reason in found.reason
    # Who accepts a second peak as high as the first gets the match.
    if reason == 'ambiguous':
        assert isinstance(match_template(search, template, max_second_ratio=1.01), Match)


def test_the_negative_of_a_patch_aligns_with_nothing() -> None:
    template = Texture(5).sample(32, 28, 12.0, 12.0)
    search = Texture(5).sample(56, 52)
    found = align(search, template, (12.0, 12.0), (0.0, 0.0))
    assert found is not None
    np.testing.assert_allclose(found.xy, [27.5, 25.5], atol=1e-3)
    assert align(255.0 - search, template, (12.0, 12.0), (0.0, 0.0)) is None


@pytest.mark.parametrize('bright', [True, False])
def test_blurring_leaves_outlines_where_light_has_them(bright: bool) -> None:
    # The corner of a thing that is much brighter, or darker, than what is around it.
    fine = np.full((480, 480), 30 if bright else 220, np.uint8)
    fine[243:, 243:] = 220 if bright else 30
    far, near = (_seen_with(fine, pixel) for pixel in (8, 4))
    template = blur_to(near, np.array([2.0, 2.0]))[1::2, 1::2][18:42, 18:42]
    found = match_template(far, template)
    assert isinstance(found, Match)
    # A pixel of the template is the lower right one of four. Were values blurred, 0.13 px off.
    np.testing.assert_allclose(found.xy, 29.5 + 0.25, atol=0.03)


def _seen_with(fine: ImageArray, pixel: int) -> Float32Array:
    """An image that a camera with a soft lens shows in as many times fewer pixels each way."""
    light = light_of(fine[..., None])[..., 0]
    soft = cv2.GaussianBlur(light, (0, 0), 0.4 * pixel)
    size = (fine.shape[1] // pixel, fine.shape[0] // pixel)
    mean = cv2.resize(soft, size, interpolation=cv2.INTER_AREA)
    return values_of(mean).astype(np.float32)
