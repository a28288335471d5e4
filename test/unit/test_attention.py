"""Attention: feature maps, what is selected in synthetic panoramas, and what is refused."""

from builders import panorama_of
import cv2
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.attention.maps import (
    AttentionConfig,
    edge_gradients,
)
from landmark_nav.learning.attention.selection import attend, refusal
from landmark_nav.types import Candidate

WIDTH, HEIGHT = 1601, 300


def panorama(gray, mask=None):
    gray = np.clip(np.rint(gray), 0, 255).astype(np.uint8)
    height, width = gray.shape
    cylinder = Cylinder(width, height, width / (2 * np.pi), (width - 1) / 2, height / 2)
    given = {} if mask is None else {'mask': mask}
    return panorama_of(np.repeat(gray[..., None], 3, axis=2), cylinder, **given)


def plaster(rng, noise=2.0, height=HEIGHT, width=WIDTH):
    """A mottled wall under sensor noise."""
    mottle = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), 12)
    return 150.0 + 6.0 * mottle / mottle.std() + rng.normal(0.0, noise, (height, width))


def target(diameter, slant_deg=0.0, rings=5):
    """Black and white rings on a board, narrowed by the slant."""
    fine = 4
    n = int(1.15 * diameter * fine)
    y, x = np.mgrid[:n, :n] - (n - 1) / 2.0
    ring = np.floor(np.hypot(x, y) / (0.5 * diameter * fine) * rings)
    board = np.where((ring < rings) & (ring % 2 == 0), 20.0, 235.0)
    size = round(n / fine * np.cos(np.radians(slant_deg))), n // fine
    return cv2.resize(board, size, interpolation=cv2.INTER_AREA)


def poster(rng, width, height):
    """Random texture: nowhere the same."""
    texture = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), 2.5)
    return 128.0 + 50.0 * texture / texture.std()


def text(rng, width, height):
    """Lines of random length."""
    page = np.full((height, width), rng.uniform(150.0, 250.0))
    for row in range(4, height - 4, 7):
        page[row : row + 3, 4 : rng.integers(10, width - 4)] = 30.0
    return page


def paste(gray, patch, column, row):
    """Put a patch with its upper left corner at (column, row), round the seam too."""
    height, width = patch.shape
    columns = np.arange(column, column + width) % gray.shape[1]
    gray[row : row + height, columns] = patch


def clutter(rng):
    gray = plaster(rng)
    for k in range(14):
        width, height = (int(v) for v in rng.integers(40, 130, 2))
        patch = (poster, text)[k % 2](rng, width, height)
        paste(gray, patch, int(rng.integers(WIDTH)), int(rng.integers(HEIGHT - height)))
    return gray


def away_px(candidate, column, row, width=WIDTH):
    across = (candidate.column - column + width / 2) % width - width / 2
    return max(abs(across), abs(candidate.row - row))


@pytest.mark.parametrize(
    ('diameter', 'slant_deg', 'rings'),
    [(30, 0, 5), (30, 50, 5), (30, 50, 7), (45, 30, 9), (60, 50, 7), (90, 0, 9), (90, 50, 5)],
)
def test_concentric_target_is_always_selected(diameter, slant_deg, rings):
    rng = np.random.default_rng(diameter + slant_deg + rings)
    gray = clutter(rng)
    board = target(diameter, slant_deg, rings)
    column = int(rng.integers(WIDTH))
    row = int(rng.integers(5, HEIGHT - board.shape[0] - 5))
    paste(gray, board, column, row)
    gray = cv2.GaussianBlur(gray, (0, 0), 0.7) + rng.normal(0.0, 2.0, gray.shape)
    center = column + (board.shape[1] - 1) / 2, row + (board.shape[0] - 1) / 2
    found = attend(panorama(gray), AttentionConfig()).candidates
    rank = int(np.argmin([away_px(c, *center) for c in found]))
    assert away_px(found[rank], *center) <= 6.0
    assert rank < 12


@pytest.mark.parametrize('noise', [0.0, 2.0])
def test_bare_wall_yields_nothing(noise):
    gray = plaster(np.random.default_rng(1), noise)
    assert attend(panorama(gray), AttentionConfig()).candidates == ()


def pattern(kind):
    row, column = np.mgrid[:200, :600].astype(np.float64)
    if kind == 'slanted edge':
        return cv2.GaussianBlur(np.where(row + column < 399, 60.0, 200.0), (0, 0), 1.0)
    bright = {
        'horizontal edge': row >= 100,
        'horizontal bars': row // 8 % 2,
        'vertical edge': column >= 300,
        'vertical bars': column // 8 % 2,
        'checkerboard': (row // 8 + column // 8) % 2,
    }
    return np.where(bright[kind], 200.0, 60.0)


def test_turning_the_panorama_turns_the_candidates():
    gray = np.clip(np.rint(clutter(np.random.default_rng(6))), 0, 255)[:, :1600]
    config = AttentionConfig(candidates=20, candidates_per_sector=20)
    there = attend(panorama(gray), config).candidates
    turned = attend(panorama(np.roll(gray, 800, axis=1)), config).candidates
    for c in there:
        assert min(away_px(d, c.column + 800, c.row, 1600) for d in turned) <= 2.0


def test_patches_stay_on_covered_pixels_and_ignore_the_rim():
    rng = np.random.default_rng(7)
    gray = clutter(rng)
    mask = np.ones(gray.shape, dtype=bool)
    rim = (20 + 15 * np.sin(np.arange(WIDTH) / 40.0)).astype(int)
    mask[np.arange(HEIGHT)[:, None] < rim] = False
    mask[:, 500:640] = False
    found = attend(panorama(np.where(mask, gray, 0.0), mask), AttentionConfig())
    assert len(found.candidates) > 10
    for c in (*found.candidates, *(c for c, _ in found.refused)):
        left, top = c.column - (c.width_px - 1) / 2, c.row - (c.height_px - 1) / 2
        columns = np.arange(round(left), round(left) + c.width_px) % WIDTH
        rows = np.arange(round(top), round(top) + c.height_px)
        assert left == round(left)
        assert top == round(top)
        assert mask[np.ix_(rows, columns)].all()

    bare = panorama(np.where(mask, plaster(rng), 0.0), mask)
    assert attend(bare, AttentionConfig()).candidates == ()


def test_directions_are_kept_varied():
    rng = np.random.default_rng(9)
    gray = plaster(rng)
    paste(gray, poster(rng, 500, 250), 0, 20)
    for column in range(600, 1500, 150):
        paste(gray, 150 + 0.4 * (poster(rng, 60, 60) - 128), column, 100)
    config = AttentionConfig(candidates=60, candidates_per_sector=6)
    found = attend(panorama(gray), config).candidates
    sectors = np.array([(c.column + 0.5) / WIDTH * 18 for c in found]).astype(int)
    assert np.bincount(sectors).max() <= 6
    for column in range(600, 1500, 150):
        assert any(column <= c.column < column + 60 for c in found)


def test_unknown_feature_and_too_small_a_panorama_are_refused():
    with pytest.raises(LandmarkNavError, match='colour'):
        AttentionConfig().alone('colour')
    with pytest.raises(LandmarkNavError, match='too small'):
        attend(panorama(np.zeros((20, 400))), AttentionConfig())


AMBIGUOUS = 'looks like its neighbourhood'


def judge(gray, column=299.5, row=99.5, *, edge=False, **values):
    noisy = gray + np.random.default_rng(0).normal(0.0, 1.0, gray.shape)
    gray = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return refusal(Candidate(column, row, 32, 32, 1.0, edge), gray, AttentionConfig(**values))


def texture():
    return poster(np.random.default_rng(1), 600, 200)


@pytest.mark.parametrize(
    'kind',
    [
        'horizontal edge',
        'horizontal bars',
        'slanted edge',
        'vertical edge',
        'vertical bars',
        'checkerboard',
    ],
)
def test_what_could_be_mistaken_is_refused(kind):
    found = judge(pattern(kind))
    assert found.reason == AMBIGUOUS


def test_an_upright_edge_is_distinct_across_unless_another_is_near():
    gray = pattern('vertical edge')
    assert judge(gray, edge=True) is None
    gray[:, 330:] = 60.0
    gray[:, 345:] = 200.0
    found = judge(gray, edge=True)
    assert found.reason == AMBIGUOUS


def test_a_copy_is_found_near_by_round_the_seam_but_not_far_away():
    gray = texture()
    patch = gray[84:116, 0:32].copy()
    gray[84:116, 560:592] = patch
    found = judge(gray, 15.5, 99.5)
    assert '-40 columns' in found.detail
    assert judge(gray, 15.5, 99.5, neighborhood_columns_px=30) is None

    gray = texture()
    gray[84:116, 300:332] = patch
    assert judge(gray, 15.5, 99.5) is None


SIZE = 200


def rectangle():
    gray = np.full((SIZE, SIZE), 60, np.uint8)
    gray[60:140, 50:150] = 200
    return gray


def gradients(gray):
    return edge_gradients(gray, 4.0, 10.0)
