import cv2
import numpy as np
import pytest
from scenes import smooth_texture

from landmark_nav.learning.stereo.wall_stereo import log_magnification, MARGIN
from landmark_nav.matching.alignment import align, Match, match_template


class Texture:
    """A random continuous texture: waves, so that it can be sampled exactly anywhere."""

    def __init__(self, seed, deviation=40.0, shortest_px=5.0):
        rng = np.random.default_rng(seed)
        length = rng.uniform(shortest_px, 6 * shortest_px, 60)
        angle = rng.uniform(0.0, 2.0 * np.pi, 60)
        turn = 2.0 * np.pi / length
        self._kx, self._ky = turn * np.cos(angle), turn * np.sin(angle)
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 60)
        self._amplitude = deviation * np.sqrt(2.0 / 60)

    def sample(self, columns, rows, x0=0.0, y0=0.0):
        # Each wave is a product of one along x and one along y.
        x = np.exp(1j * np.outer(self._kx, x0 + np.arange(columns)))
        y = np.exp(1j * (np.outer(self._ky, y0 + np.arange(rows)) + self._phase[:, None]))
        return (128.0 + self._amplitude * np.einsum('ky,kx->yx', y, x).real).astype(np.float32)


def match_shifted(seed, noise, shortest_px=5.0):
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


def test_a_sub_pixel_shift_is_recovered_without_noise():
    errors = np.array([match_shifted(seed, 0.0)[0] for seed in range(60)])
    assert np.abs(errors).max() < 0.03
    assert np.abs(errors.mean(axis=0)).max() < 0.01


@pytest.mark.parametrize('noise', [20.0, 35.0])
@pytest.mark.parametrize('shortest_px', [3.0, 5.0, 10.0])
def test_noise_moves_matches_as_far_as_their_covariance_states(noise, shortest_px):
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
    for _, found in trials:
        # Another node refuses a covariance that is not.
        np.testing.assert_allclose(found.covariance, found.covariance.T, rtol=1e-9)


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
def test_a_template_without_one_clear_place_is_refused(search, template, reason):
    found = match_template(search, template)
    assert reason in found.reason
    # Who accepts a second peak as high as the first gets the match.
    if reason == 'ambiguous':
        assert isinstance(match_template(search, template, max_second_ratio=1.01), Match)


SIZE = 28 + 2 * MARGIN


def test_a_uniform_image_shows_no_template():
    for seed in range(200):
        rng = np.random.default_rng(seed)
        steps = rng.normal(0.0, 10.0, rng.integers(8, 30, 2))
        template = (100.0 + np.cumsum(np.cumsum(steps, 0), 1)).astype(np.float32)
        search = np.full((50, 50), rng.uniform(0.1, 255.0), np.float32)
        found = align(search, template, (8.3, 8.6), (0.7, 0.7))
        assert found is None or found.score < 0.5


def two_views(rng, larger, *, blur=0.0):
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
def test_how_much_larger_a_view_shows_a_pattern_is_recovered(larger):
    for seed in range(5):
        template, found = two_views(np.random.default_rng(seed), larger)
        reported = log_magnification(template, found, 1.0)
        assert reported[0] == pytest.approx(np.log(larger), rel=0.05, abs=1e-3)


def test_its_sigma_is_that_of_the_noise():
    rng = np.random.default_rng(3)
    normalized = []
    for seed in range(100):
        template, found = two_views(np.random.default_rng(seed), 1.02)
        found = found + rng.normal(0.0, 3.0, found.shape).astype(np.float32)
        reported = log_magnification(template, found, 1.0)
        normalized.append((reported[0] - np.log(1.02)) / reported[1])
    assert 0.8 < np.sqrt(np.mean(np.square(normalized))) < 1.25


def test_what_has_no_pattern_gives_nothing():
    flat = np.full((SIZE, SIZE), 90.0, np.float32)
    assert log_magnification(flat, flat, 1.0) is None
    # Stripes grow across alone, and would from any depth.
    stripes = flat + np.float32(30.0) * np.sin(np.arange(SIZE, dtype=np.float32))
    assert log_magnification(stripes, stripes, 1.0) is None
    noise = np.random.default_rng(0).normal(90.0, 3.0, (2, SIZE, SIZE)).astype(np.float32)
    assert log_magnification(noise[0], noise[1], 1.0) is None
