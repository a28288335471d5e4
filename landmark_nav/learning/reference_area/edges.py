"""
Edges of papers in images, to sub-pixel, by colour and by brightness.

Both are measured. Brightness has full resolution even in a JPEG, but a shadow beside the paper
moves its edge outwards. Colour is not affected by shadows, but has half the resolution in a JPEG,
and may be shifted by half a pixel.

`outline_blobs` measures the outlines of coloured sheets in a panorama, independent of their places
in room.yaml. A sheet on a wall has two upright edges, which are columns of the panorama, and two
level ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from landmark_nav.arrays import BoolArray
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.panorama.synthesis import CylinderImage
from landmark_nav.learning.reference_area.blobs import hue_direction, PaperBlobs
from landmark_nav.types import FloatArray, ImageArray

# Profiles averaged for one measurement of an edge.
PROFILES = 5
_STEP_PX = 0.25
# Half width of the transition in a profile, and width of the levels on either side.
_CHANGE_PX, _LEVEL_PX = 1.75, 2.25
_LEAST_STEP = 9.0
# Brightness at which a wall is saturated, and the sigma of its edges then.
_BURNT, _BURNT_SIGMA_PX = 250.0, 0.3
# Greatest distance between the edges by colour and by brightness.
_SAME_PX = 0.7
# Step of the derivative by the camera's response, and greatest derivative of an edge.
_GAMMA_STEP, _MOST_BY_GAMMA = 0.25, 1.5
_BRIGHTNESS = np.array([0.114, 0.587, 0.299])


@dataclass(frozen=True, eq=False)
class EdgeSamples:
    """
    Edges at n places, arrays (2, n): first by colour, then by brightness.

    `offset_px` is outwards from the expected place, NaN where there is no clear edge; `sigma_px`
    is its sigma, `by_gamma` its derivative by the camera's response.
    """

    offset_px: FloatArray
    sigma_px: FloatArray
    by_gamma: FloatArray


def locate_edges(
    image: ImageArray,
    points: FloatArray,
    outwards: FloatArray,
    direction: FloatArray,
    reach_px: float,
    gamma: float = 1.0,
    most_by_gamma: float = _MOST_BY_GAMMA,
) -> EdgeSamples:
    """
    Find a paper's edges along short profiles that cross them.

    Parameters
    ----------
    image : ndarray, shape (height, width, 3)
        Image, BGR.
    points, outwards : ndarray, shape (n * PROFILES, 2)
        Expected places (column, row), and unit directions from the paper to the wall; PROFILES
        consecutive ones make one measurement.
    direction : ndarray, shape (3,)
        Direction of the paper's hue, see `hue_direction`.
    reach_px : float
        Half length of the profiles.
    gamma : float
        Exponent from pixel values to light. Lens and sensor blur light, so that edges of pixel
        values are shifted towards the darker side.
    most_by_gamma : float
        Greatest derivative of an edge by gamma, pixels.
    """
    offset = np.arange(-reach_px, reach_px + _STEP_PX / 2, _STEP_PX)
    where = points[:, None] + offset[:, None] * outwards[:, None]
    size = np.array(image.shape[1::-1])
    inside = ((where >= 0.0) & (where <= size - 1.0)).all(axis=(1, 2)).reshape(-1, PROFILES)
    low = np.clip(np.floor(where.min(axis=(0, 1))).astype(int), 0, size - 2)
    high = np.clip(np.ceil(where.max(axis=(0, 1))).astype(int) + 1, low + 2, size)
    part = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    column, row = np.moveaxis((where - low).astype(np.float32), -1, 0)
    profiles = []
    for power in (gamma, gamma + _GAMMA_STEP):
        light = cv2.LUT(part, (255.0 * (np.arange(256) / 255.0) ** power).astype(np.float32))
        colors = cv2.remap(light, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        colors = colors.reshape(-1, PROFILES, len(offset), 3).mean(axis=1, dtype=np.float64)
        profiles += [colors @ direction, colors @ _BRIGHTNESS]
    burnt = (colors.max(axis=(1, 2)) > _BURNT) * _BURNT_SIGMA_PX

    every = np.concatenate(profiles)
    start, clear = _crossing(every, offset)
    exact, sigma = _area_place(every, offset, start)
    place = np.where(clear & (np.abs(exact - start) < 0.7), exact, np.nan).reshape(2, 2, -1)
    sigma = sigma.reshape(2, 2, -1)
    by_gamma = (place[1] - place[0]) / _GAMMA_STEP
    found = inside.all(axis=1) & (np.abs(by_gamma) < most_by_gamma)
    # Both must be the same edge: the border of a shadow is not a change of hue.
    found[1] &= np.abs(place[0, 1] - place[0, 0]) < _SAME_PX
    return EdgeSamples(np.where(found, place[0], np.nan), np.hypot(sigma[0], burnt), by_gamma)


def _crossing(profiles: FloatArray, offset: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Half-way crossing of profiles (n, m), and whether it is clear."""
    reach = offset[-1]
    inner = np.median(profiles[:, offset < -0.6 * reach], axis=1)
    outer = np.median(profiles[:, offset > 0.6 * reach], axis=1)
    step = outer - inner
    share = (profiles - inner[:, None]) / np.where(np.abs(step) < 1e-6, 1e-6, step)[:, None]
    # The first place, going outwards, that is not paper.
    beyond = share > 0.5
    first = np.argmax(beyond, axis=1)
    at = np.clip(first, 1, len(offset) - 1)
    rows = np.arange(len(profiles))
    low, high = share[rows, at - 1], share[rows, at]
    place = offset[at - 1] + (0.5 - low) / np.maximum(high - low, 1e-6) * _STEP_PX
    spread = np.std(profiles[:, offset < -0.6 * reach], axis=1)
    # Beyond the edge, a clear profile stays near the level of the wall: no shadow or object.
    past = offset[None] > place[:, None] + 2.0
    wander = np.max(np.where(past, np.abs(share - 1.0), 0.0), axis=1)
    clear = (
        (np.abs(step) > np.maximum(_LEAST_STEP, 4.0 * spread))
        & beyond.any(axis=1)
        & (first > 0)
        & (wander < 0.35)
    )
    return place, clear


def _area_place(
    profiles: FloatArray, offset: FloatArray, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Edge of profiles (n, m) that preserves the area on both sides, and its sigma."""
    # It is unbiased for any sharpness and sub-pixel position; a half-way crossing of a sharp edge
    # has a bias of up to 0.09 px (Tabatabai and Mitchell, PAMI 1984).
    place = np.clip(start, offset[0] + 4.0, offset[-1] - 4.0)
    steps = np.arange(-_CHANGE_PX, _CHANGE_PX + _STEP_PX / 2, _STEP_PX)
    weight = np.full(len(steps), _STEP_PX)
    weight[[0, -1]] *= 0.5
    for _ in range(2):
        inner = _level(profiles, offset, place - _CHANGE_PX - _LEVEL_PX)
        outer = _level(profiles, offset, place + _CHANGE_PX)
        step = np.where(np.abs(outer - inner) < 1.0, 1.0, outer - inner)
        change = _at(profiles, offset, place[:, None] + steps)
        # The integral of the wall's share is the distance from the edge to the far end.
        share = (change - inner[:, None]) / step[:, None]
        place = np.clip(place + _CHANGE_PX - share @ weight, offset[0], offset[-1])
    beside = _at(profiles, offset, place[:, None] + _CHANGE_PX + np.arange(0.0, _LEVEL_PX, 0.5))
    noise = np.std(beside, axis=1) + 0.3
    return place, np.hypot(0.05, 1.5 * noise / np.abs(step))


def _level(profiles: FloatArray, offset: FloatArray, start: FloatArray) -> FloatArray:
    """Mean of each profile (n, m) from `start` (n,) on."""
    steps = np.arange(0.0, _LEVEL_PX + _STEP_PX / 2, _STEP_PX)
    return np.asarray(_at(profiles, offset, start[:, None] + steps).mean(axis=1))


def _at(profiles: FloatArray, offset: FloatArray, where: FloatArray) -> FloatArray:
    """Values of profiles (n, m) at places (n, k) along them, interpolated."""
    index = np.clip((where - offset[0]) / _STEP_PX, 0.0, len(offset) - 1.001)
    low = index.astype(np.intp)
    share = index - low
    rows = np.arange(len(profiles))[:, None]
    return np.asarray(profiles[rows, low] * (1.0 - share) + profiles[rows, low + 1] * share)


# Measurements along each edge, over this share of it, as blur rounds the corners.
_PARTS = 5
_SHARE = 0.7
# Half length of the profiles about a blob's box, in the first and the second round.
_REACH_PX = (13.0, 7.0)
# Least share of an edge that must be found, and greatest scatter about a line.
_LEAST_FOUND, _MOST_SPREAD_PX = 0.55, 1.0
# Sigma of the error that all points of an edge share: shadows, blur, half-resolution chroma.
_EDGE_SIGMA_PX = 0.15
# Usual response of a camera to light, and its sigma.
_GAMMA, _GAMMA_SIGMA = 1.4, 0.4


@dataclass(frozen=True, eq=False)
class PaperOutlines(PaperBlobs):
    """
    Measured outlines of sheets of one colour.

    `sigma` (n, 4) is that of the edges, `by_response` (n, 4) their outward shift by one sigma of
    the camera's response.
    """

    sigma: FloatArray
    by_response: FloatArray


def outline_blobs(view: CylinderImage, color: str, blobs: PaperBlobs) -> PaperOutlines:
    """Measure the edges of blobs of a colour; those without four clear ones are left out."""
    hue = hue_direction(color)
    rows = []
    for edges, misfit in zip(blobs.edges, blobs.misfit, strict=True):
        outline = _outline(view, hue, edges)
        if outline is not None:
            rows.append(np.array([*outline, np.full(4, misfit)]))
    table = np.reshape(rows, (-1, 4, 4))
    edges, sigma, by_response, misfit = np.moveaxis(table[_distinct(table)], 1, 0)
    return PaperOutlines(edges, misfit[:, 0], sigma, by_response)


def _outline(
    view: CylinderImage, hue: FloatArray, box: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Edges (4,) as of blobs, sigmas and shifts by response (4,); None without four edges."""
    cylinder = view.cylinder
    sigma = by_gamma = np.zeros(4)
    for reach in _REACH_PX:
        image, start = _part(view, box, reach + 6.0)
        right, left = cylinder.cx - cylinder.fx * box[:2] - start[0]
        bottom, top = cylinder.row_of(box[2:]) - start[1]
        if right - left < 4.0 or bottom - top < 4.0:
            return None
        half = 0.5 * np.array([right - left, bottom - top])
        along = np.linspace(-_SHARE, _SHARE, _PARTS * PROFILES)[:, None]
        sides = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        offsets = np.concatenate([half * np.where(side, side, along) for side in sides])
        points = np.array([left, top]) + half + offsets
        outwards = np.repeat(sides, len(along), axis=0)
        inner = min(reach, max(5.0, 1.2 * float(half.min())))
        found = locate_edges(image, points, outwards, hue, inner, _GAMMA, np.inf)
        own = np.hypot(found.sigma_px, _GAMMA_SIGMA * np.abs(found.by_gamma))
        shift, sigma, by_gamma = _lines(found.offset_px, own, found.by_gamma)
        if not np.isfinite(shift).all():
            return None
        # Columns increase clockwise, rows downwards.
        scale = [cylinder.fx, cylinder.fx, cylinder.fy, cylinder.fy]
        box = box + np.array([-1.0, 1.0, -1.0, 1.0]) * shift / scale
    return box, sigma / cylinder.fx, _GAMMA_SIGMA * by_gamma / cylinder.fx


def _lines(
    offset_px: FloatArray, sigma_px: FloatArray, by_gamma: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Middles (4,) of lines along four edges, NaN without one; sigmas, derivatives by gamma."""
    along = np.linspace(-1.0, 1.0, _PARTS)
    middle, sigma, slope = np.full((3, 4), np.nan)
    # Brightness first, which colour replaces where there is enough of it.
    parts = (v.reshape(2, 4, _PARTS)[::-1] for v in (offset_px, sigma_px, by_gamma))
    for offsets, own, slopes in zip(*parts, strict=True):
        for edge, good in enumerate(np.isfinite(offsets)):
            if good.mean() < _LEAST_FOUND:
                continue
            off = offsets[edge, good]
            line = np.polyfit(along[good], off, 1)
            spread = float(np.sqrt(np.mean((off - np.polyval(line, along[good])) ** 2)))
            if spread <= _MOST_SPREAD_PX:
                scatter = np.hypot(spread, np.mean(own[edge, good])) / np.sqrt(good.sum())
                middle[edge], sigma[edge] = line[1], np.hypot(_EDGE_SIGMA_PX, scatter)
                slope[edge] = slopes[edge, good].mean()
    return middle, sigma, slope


def _part(view: CylinderImage, box: FloatArray, margin_px: float) -> tuple[ImageArray, FloatArray]:
    """Part of a panorama around a box, possibly across the seam; its first column and row."""
    cylinder: Cylinder = view.cylinder
    first = int(np.floor(cylinder.cx - cylinder.fx * box[1] - margin_px))
    last = int(np.ceil(cylinder.cx - cylinder.fx * box[0] + margin_px))
    columns = np.arange(first, last + 1) % cylinder.width
    low, high = np.sort(cylinder.row_of(box[2:]))
    top = max(0, int(np.floor(low - margin_px)))
    bottom = min(cylinder.height, int(np.ceil(high + margin_px)) + 1)
    part = np.ascontiguousarray(view.image[top:bottom][:, columns])
    return part, np.array([first, top], dtype=np.float64)


def _distinct(table: FloatArray) -> list[int]:
    """Of outlines (n, 4, 4): edges, sigmas, shifts, misfit; indices of one for each sheet."""
    kept: list[int] = []
    for k in np.argsort(table[:, 3, 0], kind='stable').tolist():
        if all(np.abs(table[k, 0] - table[j, 0]).max() > 0.01 for j in kept):
            kept.append(k)
    return kept
