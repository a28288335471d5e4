"""Feature maps, symmetry and conspicuity on patterns whose answer is known."""

import cv2
import numpy as np
import pytest

from landmark_nav.learning.attention.maps import (
    conspicuity_map,
    corner_map,
    edge_gradients,
    edge_map,
    point_symmetry_map,
)

SIZE = 200


def rectangle():
    gray = np.full((SIZE, SIZE), 60, np.uint8)
    gray[60:140, 50:150] = 200
    return gray


def rings(slant_deg, dark):
    y, x = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2.0
    distance = np.hypot(x / np.cos(np.radians(slant_deg)), y)
    inside = (distance < 40.0) & (np.floor(distance / 8.0) % 2 == int(dark))
    return cv2.GaussianBlur(np.where(inside, 220, 40).astype(np.uint8), (0, 0), 0.7)


def horizontal_bars():
    return np.repeat(np.where(np.arange(SIZE) // 8 % 2 == 0, 40, 220)[:, None], SIZE, 1).astype(
        np.uint8
    )


def gradients(gray):
    return edge_gradients(gray, 4.0, 10.0)


def test_edges_lie_on_the_outline_only():
    edges = edge_map(gradients(rectangle()))
    assert edges.dtype == np.float32
    assert edges.max() == 1.0
    assert edges[100, 48:53].max() > 0.8
    assert edges[58:63, 100].max() > 0.8
    assert edges[80:120, 70:130].max() == 0.0
    assert edges[:40].max() == 0.0


def test_corners_are_at_corners_and_not_between_parallel_lines():
    corners = corner_map(gradients(rectangle()))
    assert corners[55:66, 45:56].max() > 0.3
    assert corners[90:110, 45:56].max() < 0.05
    assert corner_map(gradients(horizontal_bars())).max() < 0.05


def test_noise_has_no_edges():
    rng = np.random.default_rng(0)
    gray = np.clip(150 + rng.normal(0, 6, (SIZE, SIZE)), 0, 255).astype(np.uint8)
    edges = gradients(gray)
    assert edge_map(edges).max() == 0.0
    assert point_symmetry_map(edges).max() == 0.0


@pytest.mark.parametrize('slant_deg', [0.0, 30.0, 50.0])
@pytest.mark.parametrize('dark', [False, True])
def test_point_symmetry_peaks_at_the_centre_of_rings(slant_deg, dark):
    symmetry = point_symmetry_map(gradients(rings(slant_deg, dark=dark)))
    row, column = np.unravel_index(symmetry.argmax(), symmetry.shape)
    assert symmetry.max() > 0.4
    assert abs(2 * row - SIZE / 2) <= 4
    assert abs(2 * column - SIZE / 2) <= 4


def test_point_symmetry_ignores_horizontal_edges():
    inside = point_symmetry_map(gradients(horizontal_bars()))[20:-20, 20:-20]
    assert inside.max() < 0.05


def test_conspicuity_prefers_one_peak_to_many():
    one = np.zeros((SIZE, SIZE), np.float32)
    one[100, 100] = 1.0
    many = np.zeros((SIZE, SIZE), np.float32)
    many[20::40, 20::40] = 1.0
    many[100, 100] = 1.2
    assert conspicuity_map(one, 2.0, 8.0).max() == pytest.approx(1.0)
    assert conspicuity_map(many, 2.0, 8.0).max() < 0.15
    assert conspicuity_map(np.full_like(one, 0.7), 2.0, 8.0).max() == 0.0
