"""Coloured papers in a cylinder image: blobs by hue, then their edges to sub-pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.panorama import CylinderImage
from landmark_nav.types import FloatArray, ImageArray

__all__ = ['HUES', 'EdgeSamples', 'PaperBlobs', 'find_blobs', 'locate_edges', 'opponent_image']

# Hue of each colour name, in OpenCV's half degrees.
HUES = {'red': 0, 'orange': 12, 'yellow': 30, 'green': 60, 'cyan': 90, 'blue': 120, 'magenta': 150}

_HUE_TOLERANCE = 14
_SEARCH_PX = 7.0
_STEP_PX = 0.25


@dataclass(frozen=True, eq=False)
class PaperBlobs:
    """
    Blobs of one colour, largest first, arrays over the blobs.

    `azimuth_rad` (n,) in the base frame; `tangent` (n, 2) of the elevation of top and bottom.
    """

    azimuth_rad: FloatArray
    tangent: FloatArray


@dataclass(frozen=True, eq=False)
class EdgeSamples:
    """
    Where an edge was found along profiles across it, arrays over the profiles.

    `offset_px` (n,) is measured from the expected place outwards, NaN where there is no clear
    edge; `sigma_px` (n,) its standard deviation.
    """

    offset_px: FloatArray
    sigma_px: FloatArray


def find_blobs(view: CylinderImage, color: str) -> PaperBlobs:
    """
    Compact blobs of a colour that could be a paper.

    Raises
    ------
    LandmarkNavError
        The colour has no known hue.

    """
    if color not in HUES:
        raise LandmarkNavError(
            f'paper colour {color!r} is not known: take one of {", ".join(HUES)}'
        )
    cylinder = view.cylinder
    pad = cylinder.width // 8
    image = cv2.copyMakeBorder(view.image, 0, 0, 0, pad, cv2.BORDER_WRAP)
    # Sensor noise on grey walls has hue and saturation too; a small median takes it away.
    hue, saturation, value = cv2.split(cv2.cvtColor(cv2.medianBlur(image, 5), cv2.COLOR_BGR2HSV))
    distance = np.abs((hue.astype(np.int16) - HUES[color] + 90) % 180 - 90)
    mask = (distance <= _HUE_TOLERANCE) & (saturation > 90) & (value > 25)
    _, _, stats, centers = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    found = []
    for (left, top, width, height, area), center in zip(stats[1:], centers[1:], strict=True):
        # Each blob of the turn starts once in (0, width]; what crosses the seam is whole there.
        whole = 0 < left <= cylinder.width and left + width < image.shape[1]
        solid = area >= 60 and area >= 0.55 * width * height
        if whole and solid and 0.15 < width / height < 6.0:
            found.append((float(area), float(center[0]), top - 0.5, top + height - 0.5))
    found.sort(reverse=True)
    rows = np.array(found).reshape(-1, 4)
    return PaperBlobs(cylinder.azimuth_rad(rows[:, 1]), cylinder.tangent(rows[:, 2:]))


def opponent_image(image: ImageArray, color: str) -> FloatArray:
    """How much of the hue each pixel of a BGR image has; zero on grey, so shadows don't count."""
    hue = np.array([[[HUES[color], 255, 255]]], dtype=np.uint8)
    direction = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0].astype(np.float64)
    direction -= direction.mean()
    direction /= np.abs(direction).sum() / 2.0
    return np.asarray(image.astype(np.float64) @ direction)


def locate_edges(
    luminance: FloatArray,
    opponent: FloatArray,
    cylinder: Cylinder,
    points: FloatArray,
    outwards: FloatArray,
) -> EdgeSamples:
    """
    Find a paper's edge along short profiles that cross it.

    Luminance decides where the wall next to the edge is as bright as farther out. Where a shadow
    or a neighbour touches the edge, the colour decides, with the larger error of an image whose
    chroma was halved.

    Parameters
    ----------
    luminance, opponent : ndarray, shape (height, width)
        Brightness, and how much of the paper's hue there is; float32.
    cylinder : Cylinder
        Geometry of both.
    points : ndarray, shape (n, 2)
        Expected places (column, row).
    outwards : ndarray, shape (n, 2)
        Unit directions from the paper to the wall.

    Returns
    -------
    EdgeSamples

    """
    offset = np.arange(-_SEARCH_PX, _SEARCH_PX + _STEP_PX / 2, _STEP_PX)
    where = points[:, None] + offset[:, None] * outwards[:, None]
    where[..., 0] = cylinder.wrap_column(where[..., 0])
    bright, bright_clear = _crossing(_sample(luminance, where), offset)
    color, color_clear = _crossing(_sample(opponent, where), offset)
    # Both must mean the same edge: a shadow's border is not a change of hue.
    agree = bright_clear & color_clear & (np.abs(bright - color) < 0.7)
    place = np.where(agree, bright, np.where(color_clear, color, np.nan))
    return EdgeSamples(place, np.where(agree, 0.15, 0.5))


def _sample(image: FloatArray, where: FloatArray) -> FloatArray:
    column, row = np.moveaxis(where.astype(np.float32), -1, 0)
    found = cv2.remap(
        image.astype(np.float32), column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    )
    return np.asarray(found, dtype=np.float64)


def _crossing(
    profiles: FloatArray, offset: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Half-way crossing nearest to the middle of each profile (n, m), and whether it is clear."""
    inner = np.median(profiles[:, offset < -0.6 * _SEARCH_PX], axis=1)
    outer = np.median(profiles[:, offset > 0.6 * _SEARCH_PX], axis=1)
    step = outer - inner
    share = (profiles - inner[:, None]) / np.where(np.abs(step) < 1e-6, 1e-6, step)[:, None]
    # The last place, going outwards, before which everything is still paper.
    beyond = share > 0.5
    first = np.argmax(beyond, axis=1)
    at = np.clip(first, 1, len(offset) - 1)
    rows = np.arange(len(profiles))
    low, high = share[rows, at - 1], share[rows, at]
    place = offset[at - 1] + (0.5 - low) / np.maximum(high - low, 1e-6) * _STEP_PX
    spread = np.std(profiles[:, offset < -0.6 * _SEARCH_PX], axis=1)
    # Past the edge a clear profile stays near the level of the wall: no shadow, no neighbour.
    past = offset[None] > place[:, None] + 2.0
    wander = np.max(np.where(past, np.abs(share - 1.0), 0.0), axis=1)
    clear = (
        (np.abs(step) > np.maximum(10.0, 4.0 * spread))
        & beyond.any(axis=1)
        & (first > 0)
        & (wander < 0.35)
    )
    return place, clear
