from __future__ import annotations

import cv2
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.panorama import CylinderImage
from landmark_nav.learning.papers import find_blobs, HUES, locate_edges, opponent_image
from landmark_nav.types import FloatArray, ImageArray

CYLINDER = Cylinder.with_resolution(200.0, -0.3, 0.3)
SHAPE = (CYLINDER.height, CYLINDER.width)


def color_of(name: str, saturation: int = 200, value: int = 190) -> FloatArray:
    hsv = np.array([[[HUES[name], saturation, value]]], np.uint8)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0], dtype=np.float64)


def wall_with(rectangles: list[tuple[FloatArray, float, float, float, float]]) -> FloatArray:
    """Grey wall with rectangles of (colour, left, top, width, height), sub-pixel, wrapped."""
    image = np.full((*SHAPE, 3), 160.0)
    columns, rows = np.arange(SHAPE[1]), np.arange(SHAPE[0])
    for color, left, top, width, height in rectangles:
        # Share of each pixel that the rectangle covers.
        off = np.mod(columns - left + SHAPE[1] / 2.0, SHAPE[1]) - SHAPE[1] / 2.0
        across = np.clip(np.minimum(off + 0.5, width - off + 0.5), 0.0, 1.0)
        down = np.clip(np.minimum(rows - top + 0.5, top + height - rows + 0.5), 0.0, 1.0)
        share = (down[:, None] * across)[..., None]
        image = (1.0 - share) * image + share * color
    return image


def view_of(image: FloatArray, noise: float = 0.0) -> CylinderImage:
    rng = np.random.default_rng(0)
    noisy = image + noise * rng.standard_normal(image.shape)
    pixels: ImageArray = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return CylinderImage(pixels, np.ones(SHAPE, bool), CYLINDER)


# Orange lies between red and yellow, too near to be told from either.
PURE = sorted(set(HUES) - {'orange'})


@pytest.mark.parametrize('color', PURE)
def test_each_colour_is_found_among_the_others(color: str) -> None:
    image = wall_with(
        [(color_of(n), 60.0 + 160.0 * k, 40.0, 20.0, 28.0) for k, n in enumerate(PURE)]
    )
    blobs = find_blobs(view_of(image, noise=6.0), color)
    assert len(blobs.azimuth_rad) == 1
    column = 60.0 + 160.0 * PURE.index(color) + 10.0
    assert blobs.azimuth_rad[0] == pytest.approx(float(CYLINDER.azimuth_rad(column)), abs=0.005)
    np.testing.assert_allclose(
        blobs.tangent[0], CYLINDER.tangent(np.array([40.0, 68.0])), atol=0.008
    )


def test_blobs_come_largest_first_and_once_across_the_seam() -> None:
    red = color_of('red')
    image = wall_with([(red, 300.0, 30.0, 14.0, 20.0), (red, SHAPE[1] - 12.0, 30.0, 24.0, 30.0)])
    blobs = find_blobs(view_of(image), 'red')
    assert len(blobs.azimuth_rad) == 2
    seam = float(CYLINDER.azimuth_rad(SHAPE[1]))
    off = np.angle(np.exp(1j * (blobs.azimuth_rad[0] - seam)))
    assert abs(off) < 0.006
    assert blobs.azimuth_rad[1] == pytest.approx(float(CYLINDER.azimuth_rad(307.0)), abs=0.006)


def test_pale_dark_thin_and_ragged_things_are_no_papers() -> None:
    image = wall_with(
        [
            (color_of('red', saturation=60), 100.0, 40.0, 20.0, 28.0),
            (color_of('red', value=15), 300.0, 40.0, 20.0, 28.0),
            (color_of('red'), 500.0, 20.0, 120.0, 6.0),
            (color_of('red'), 700.0, 40.0, 5.0, 5.0),
            # An L.
            (color_of('red'), 900.0, 20.0, 8.0, 60.0),
            (color_of('red'), 900.0, 72.0, 50.0, 8.0),
        ]
    )
    assert len(find_blobs(view_of(image), 'red').azimuth_rad) == 0


def test_an_unknown_colour_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(LandmarkNavError, match="'beige' is not known: take one of red"):
        find_blobs(view_of(wall_with([])), 'beige')


@pytest.mark.parametrize('color', sorted(HUES))
def test_only_the_hue_counts_for_the_opponent_image(color: str) -> None:
    grey = np.arange(0, 256, 15, dtype=np.uint8).repeat(3).reshape(1, -1, 3)
    np.testing.assert_allclose(opponent_image(grey, color), 0.0, atol=1e-9)
    own = color_of(color, saturation=255, value=200).reshape(1, 1, 3).astype(np.uint8)
    assert opponent_image(own, color)[0, 0] > 90.0


def edges_of(
    image: FloatArray, left: float, rows: FloatArray, guess: float
) -> tuple[FloatArray, FloatArray]:
    """Columns (n,) found of a paper's left edge near `left` + `guess`, and their sigmas."""
    view = view_of(cv2.GaussianBlur(image, (0, 0), 0.8), noise=1.0)
    luminance = view.image.astype(np.float64) @ [0.114, 0.587, 0.299]
    points = np.stack([np.full(len(rows), left + guess), rows], -1)
    outwards = np.tile([-1.0, 0.0], (len(rows), 1))
    found = locate_edges(luminance, opponent_image(view.image, 'red'), CYLINDER, points, outwards)
    return left + guess - found.offset_px, found.sigma_px


ROWS = np.linspace(45.0, 62.0, 9)


@pytest.mark.parametrize('left', [200.0, 200.3, 200.5, 3.7])
@pytest.mark.parametrize('guess', [-2.0, 0.0, 1.5])
def test_an_edge_is_found_to_a_tenth_of_a_pixel(left: float, guess: float) -> None:
    image = wall_with([(color_of('red'), left, 40.0, 26.0, 28.0)])
    found, sigma = edges_of(image, left, ROWS, guess)
    assert np.isfinite(found).all()
    assert np.abs(found - left).mean() < 0.1
    assert sigma.max() < 0.3


def test_beside_a_shadow_the_colour_decides() -> None:
    shadow = np.array([110.0, 110.0, 110.0])
    image = wall_with(
        [(shadow, 196.5, 36.0, 6.0, 36.0), (color_of('red'), 200.3, 40.0, 26.0, 28.0)]
    )
    found, sigma = edges_of(image, 200.3, ROWS, 0.5)
    assert np.isfinite(found).all()
    assert np.abs(found - 200.3).mean() < 0.4
    # It says that it knows less.
    assert sigma.min() >= 0.5


def test_where_there_is_no_paper_there_is_no_edge() -> None:
    found, _ = edges_of(wall_with([]), 200.0, ROWS, 0.0)
    assert np.isnan(found).all()
    far = wall_with([(color_of('red'), 230.0, 40.0, 26.0, 28.0)])
    assert np.isnan(edges_of(far, 200.0, ROWS, 0.0)[0]).all()
