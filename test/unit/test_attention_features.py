"""Feature maps, symmetry and conspicuity on patterns whose answer is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from landmark_nav.learning.attention.maps import (
    conspicuity_map,
    corner_map,
    edge_gradients,
    edge_map,
    intensity_map,
    line_symmetry_map,
    point_symmetry_map,
    radial_symmetry_map,
    vertical_edge_map,
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


def test_vertical_edges_leave_horizontal_ones_out():
    vertical = vertical_edge_map(gradients(rectangle()))
    assert vertical[100, 48:53].max() > 0.8
    assert vertical[50:70, 70:130].max() == 0.0


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


@pytest.mark.parametrize('dark', [False, True])
def test_radial_symmetry_peaks_at_the_centre_of_rings_and_hardly_beside_edges(dark):
    symmetry = radial_symmetry_map(gradients(rings(30.0, dark=dark)))
    row, column = np.unravel_index(symmetry.argmax(), symmetry.shape)
    assert abs(2 * row - SIZE / 2) <= 4
    assert abs(2 * column - SIZE / 2) <= 4
    assert symmetry.max() > 0.35
    assert radial_symmetry_map(gradients(horizontal_bars())).max() < 0.06


def test_line_symmetry_is_high_on_the_axis_and_ignores_horizontal_bars():
    rng = np.random.default_rng(1)
    half = cv2.GaussianBlur(rng.normal(size=(SIZE, SIZE // 2)), (0, 0), 3)
    half = 0.5 + 0.2 * half / half.std()
    mirrored = np.concatenate([half, half[:, ::-1]], axis=1).astype(np.float32)
    symmetry = line_symmetry_map(mirrored, 0.02)
    profile = symmetry.mean(axis=0)[10:-10]
    assert abs(int(profile.argmax()) + 10 - SIZE // 4) <= 1
    assert profile.max() > 0.7
    assert line_symmetry_map(intensity_map(horizontal_bars()), 0.02).max() < 0.01


def test_conspicuity_prefers_one_peak_to_many():
    one = np.zeros((SIZE, SIZE), np.float32)
    one[100, 100] = 1.0
    many = np.zeros((SIZE, SIZE), np.float32)
    many[20::40, 20::40] = 1.0
    many[100, 100] = 1.2
    assert conspicuity_map(one, 2.0, 8.0).max() == pytest.approx(1.0)
    assert conspicuity_map(many, 2.0, 8.0).max() < 0.15
    assert conspicuity_map(np.full_like(one, 0.7), 2.0, 8.0).max() == 0.0
