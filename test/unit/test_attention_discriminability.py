"""Patches that a neighbouring location could be mistaken for are refused."""

import cv2
import numpy as np
import pytest

from landmark_nav.learning.attention.maps import AttentionConfig
from landmark_nav.learning.attention.selection import refusal
from landmark_nav.types import Candidate

WIDTH, HEIGHT = 600, 200
AMBIGUOUS = 'looks like a place near by'


def judge(gray, column=299.5, row=99.5, *, edge=False, **values):
    noisy = gray + np.random.default_rng(0).normal(0.0, 1.0, gray.shape)
    gray = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return refusal(Candidate(column, row, 32, 32, 1.0, edge), gray, AttentionConfig(**values))


def texture(seed=1):
    field = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH)), (0, 0), 2.5)
    return 128.0 + 40.0 * field / field.std()


def grid():
    return np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)


def test_unique_texture_is_accepted_anywhere():
    for column, row in ((299.5, 99.5), (0.5, 99.5), (599.5, 15.5), (10.5, 183.5)):
        assert judge(texture(), column, row) is None


def pattern(kind):
    row, column = grid()
    if kind == 'horizontal edge':
        return np.where(row < 100, 60.0, 200.0)
    if kind == 'horizontal bars':
        return np.where(row // 8 % 2 == 0, 60.0, 200.0)
    if kind == 'slanted edge':
        return cv2.GaussianBlur(np.where(row + column < 399, 60.0, 200.0), (0, 0), 1.0)
    if kind == 'vertical edge':
        return np.where(column < 300, 60.0, 200.0)
    if kind == 'vertical bars':
        return np.where(column // 8 % 2 == 0, 60.0, 200.0)
    return np.where((row // 8 + column // 8) % 2 == 0, 60.0, 200.0)


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
    assert found is not None
    assert found.reason == AMBIGUOUS


def test_an_upright_edge_is_distinct_across_unless_another_is_near():
    gray = pattern('vertical edge')
    assert judge(gray, edge=True) is None
    gray[:, 330:] = 60.0
    gray[:, 345:] = 200.0
    found = judge(gray, edge=True)
    assert found is not None
    assert found.reason == AMBIGUOUS


def test_a_blank_patch_is_refused():
    found = judge(np.full((HEIGHT, WIDTH), 150.0))
    assert found is not None
    assert found.reason == 'too little contrast'


def test_a_copy_is_found_near_by_round_the_seam_but_not_far_away():
    gray = texture()
    patch = gray[84:116, 0:32].copy()
    gray[84:116, 560:592] = patch
    found = judge(gray, 15.5, 99.5)
    assert found is not None
    assert '-40 columns' in found.detail
    assert judge(gray, 15.5, 99.5, neighborhood_columns_px=30) is None

    gray = texture()
    gray[84:116, 300:332] = patch
    assert judge(gray, 15.5, 99.5) is None
