from __future__ import annotations

import colorsys

import cv2
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import NAMED_HUES_DEG, paper_bgr
from landmark_nav.learning.panorama.synthesis import CylinderImage
from landmark_nav.learning.reference_area.blobs import ColorSearch, hue_direction
from landmark_nav.learning.reference_area.edges import locate_edges, PROFILES
from landmark_nav.types import FloatArray

CYLINDER = Cylinder.with_resolution(200.0, -0.3, 0.3)
SHAPE = (CYLINDER.height, CYLINDER.width)

Rectangle = tuple[FloatArray, float, float, float, float]


def hue_deg(color):
    blue, green, red = paper_bgr(color)
    return 360.0 * colorsys.rgb_to_hsv(red, green, blue)[0]


def color_of(name, saturation=200, value=190):
    hsv = np.array([[[round(hue_deg(name) / 2.0) % 180, saturation, value]]], np.uint8)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0], dtype=np.float64)


def wall_with(rectangles):
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


def camera_image(image, noise=0.0):
    rng = np.random.default_rng(0)
    noisy = image + noise * rng.standard_normal(image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def search_in(image, noise=0.0):
    return ColorSearch(CylinderImage(camera_image(image, noise), np.ones(SHAPE, bool), CYLINDER))


def azimuths(blobs):
    return np.asarray(blobs.edges[:, :2].mean(axis=1))


def test_a_paper_is_found_among_books_that_have_rather_its_hue():
    books: list[Rectangle] = [
        (color_of('green'), 40.0 + 16.0 * (k % 30), 10.0 + 45.0 * (k // 30), 8.0, 20.0)
        for k in range(60)
    ]
    yellowish = 0.85 * color_of('green') + 0.15 * color_of('yellow')
    blobs = search_in(wall_with([*books, (yellowish, 700.0, 30.0, 22.0, 31.0)])).blobs('green')
    azimuth = CYLINDER.azimuth_rad(700.0 + 10.5)
    assert np.abs(azimuths(blobs) - azimuth).min() < 0.01


@pytest.mark.parametrize('light', [(1.0, 1.0, 1.0), (0.5, 0.75, 1.0), (0.25, 0.24, 0.2)], ids=str)
def test_each_colour_is_found_among_the_others_in_any_light(light):
    names = sorted(NAMED_HUES_DEG)
    left = 40.0 + 110.0 * np.arange(len(names))
    image = wall_with(
        [(color_of(n), x, 40.0, 20.0, 28.0) for n, x in zip(names, left, strict=True)]
    )
    search = search_in(image * np.array(light), noise=3.0)
    for color, x in zip(names, left, strict=True):
        blobs = search.blobs(color)
        azimuth = float(CYLINDER.azimuth_rad(x + 10.0))
        assert azimuths(blobs)[0] == pytest.approx(azimuth, abs=0.006), color
        np.testing.assert_allclose(
            blobs.edges[0, 2:], CYLINDER.tangent(np.array([68.0, 40.0])), atol=0.009
        )
        # Neighbours in hue are there too, and fit worse.
        assert (blobs.misfit[1:] > blobs.misfit[0] + 1.0).all()


def test_a_blob_is_found_once_across_the_seam():
    red = color_of('red')
    image = wall_with([(red, 300.0, 30.0, 14.0, 20.0), (red, SHAPE[1] - 12.0, 30.0, 24.0, 30.0)])
    blobs = search_in(image).blobs('red')
    expected = CYLINDER.azimuth_rad(np.array([307.0, SHAPE[1]]))
    off = np.angle(np.exp(1j * (azimuths(blobs)[:, None] - expected)))
    assert (np.abs(off) < 0.006).sum(axis=0).tolist() == [1, 1]


@pytest.mark.parametrize(
    ('color', 'hue'),
    [('#ff8000', 30.1), ('hsv(210, 80%, 70%)', 210.0), (' Green ', NAMED_HUES_DEG['green'])],
)
def test_colours_by_name_and_number(color, hue):
    assert hue_deg(color) == pytest.approx(hue, abs=0.1)


@pytest.mark.parametrize(
    ('color', 'message'),
    [
        ('beige', "'beige' is not known: take one of red"),
        ('#12', 'is not known'),
        ('hsv(20, 10, 90)', 'too grey'),
        ('#0a0000', 'too dark'),
    ],
)
def test_what_is_no_colour_is_refused(color, message):
    with pytest.raises(LandmarkNavError, match=message):
        paper_bgr(color)


def edges_of(image, at, blur_px, guess, side, gamma=1.0):
    """Offsets outwards (2, n) from the true left (side 0) or top (1) edge, and their sigmas."""
    if blur_px:
        image = cv2.GaussianBlur(image, (0, 0), blur_px)
    jpeg = cv2.imencode('.jpg', camera_image(image, noise=1.0), [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
    decoded = np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), dtype=np.uint8)
    along = 47.0 + np.arange(4 * PROFILES) if side == 0 else 208.0 + np.arange(4 * PROFILES)
    across = np.full(len(along), at + guess)
    points = np.stack([across, along] if side == 0 else [along, across], -1)
    outwards = np.tile([-1.0, 0.0] if side == 0 else [0.0, -1.0], (len(along), 1))
    found = locate_edges(decoded, points, outwards, hue_direction('red'), 7.0, gamma)
    return found.offset_px - guess, found.sigma_px


@pytest.mark.parametrize('blur_px', [0.0, 0.5, 1.0])
@pytest.mark.parametrize('side', [0, 1], ids=['left', 'top'])
def test_edges_in_jpeg_with_halved_colours_are_unbiased(blur_px, side):
    """However sharp the image, wherever in its pixel the edge lies."""
    means = []
    for shift in np.arange(0.0, 2.0, 0.25):
        place = (200.0 + shift, 40.0) if side == 0 else (200.0, 40.0 + shift)
        image = wall_with([(color_of('red'), *place, 40.0, 40.0)])
        at = place[side]
        for guess in (-1.5, 0.4):
            offset, sigma = edges_of(image, at, blur_px, guess, side)
            assert np.isfinite(offset).all()
            assert (sigma < 0.25).all()
            means.append(offset.mean(axis=1))
    color, bright = np.array(means).T
    assert np.abs(bright).max() < 0.06
    assert abs(np.mean(bright)) < 0.02
    # Colours are halved: an edge between two of their pixels is drawn to one of them.
    assert np.abs(color).max() < 0.3
    assert abs(np.mean(color)) < 0.05


def test_where_there_is_no_paper_there_is_no_edge():
    assert np.isnan(edges_of(wall_with([]), 200.0, 0.6, 0.0, 0)[0]).all()
    far = wall_with([(color_of('red'), 230.0, 40.0, 40.0, 40.0)])
    assert np.isnan(edges_of(far, 200.0, 0.6, 0.0, 0)[0]).all()
