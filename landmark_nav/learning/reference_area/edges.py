"""
Edges of papers in images, to sub-pixel: where colour and brightness change across them.

Both are measured. Brightness has every pixel of its own even in a JPEG, but what lies beside a
paper is often its own shadow, which moves the edge outwards; colour is not deceived by shadows,
but halved in a JPEG, and may lie half a pixel beside.

Outlines of coloured sheets in a panorama, wherever room.yaml says that papers hang.

A sheet on a wall has two upright edges, which are columns of the panorama, and two level ones.
What is measured here knows nothing of where papers should hang: it shows which of them does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.panorama import CylinderImage
from landmark_nav.learning.reference_area.blobs import hue_direction, PaperBlobs
from landmark_nav.types import FloatArray, ImageArray

# Profiles that are averaged for one measurement of an edge.
PROFILES = 5

_STEP_PX = 0.25
# Half width of the part of a profile that holds the whole change, and of the levels beside it.
_CHANGE_PX, _LEVEL_PX = 1.75, 2.25

_LEAST_STEP = 9.0
# Brightness from which a wall is burnt out: its edges are uncertain.
_BURNT, _BURNT_SIGMA_PX = 250.0, 0.3
# Farther from the change of colour a step in brightness is another one.
_SAME_PX = 0.7

# The response is varied by so much; an edge that it moves farther is none.
_GAMMA_STEP, _MOST_BY_GAMMA = 0.25, 1.5

_BRIGHTNESS = np.array([0.114, 0.587, 0.299])


@dataclass(frozen=True, eq=False)
class EdgeSamples:
    """
    Where edges were found, arrays (2, n): first by colour, then by brightness, at n places.

    `offset_px` is measured from the expected place outwards, NaN where there is no clear edge;
    `sigma_px` its standard deviation; `by_gamma` its derivative by the camera's response.
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
    points : ndarray, shape (n * PROFILES, 2)
        Expected places (column, row); PROFILES in turn make one measurement.
    outwards : ndarray, shape (n * PROFILES, 2)
        Unit directions from the paper to the wall.
    direction : ndarray, shape (3,)
        Of the paper's hue, see `hue_direction`.
    reach_px : float
        How far to both sides the profiles go.
    gamma : float
        Power of the pixels' values that is light: lens and sensor blur light, so that edges of
        what the camera made of it seem moved towards the darker side.
    most_by_gamma : float
        Pixels by which gamma may move an edge, for a unit of it.
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
        light = cv2.LUT(part, _light(power))
        colors = cv2.remap(light, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        colors = colors.reshape(-1, PROFILES, len(offset), 3).mean(axis=1, dtype=np.float64)
        profiles += [colors @ direction, colors @ _BRIGHTNESS]
    burnt = (colors.max(axis=(1, 2)) > _BURNT) * _BURNT_SIGMA_PX

    place, sigma = (v.reshape(2, 2, -1) for v in _edge(np.concatenate(profiles), offset))
    by_gamma = (place[1] - place[0]) / _GAMMA_STEP
    found = inside.all(axis=1) & (np.abs(by_gamma) < most_by_gamma)
    # Both must mean the same edge: a shadow's border is not a change of hue.
    found[1] &= np.abs(place[0, 1] - place[0, 0]) < _SAME_PX
    return EdgeSamples(np.where(found, place[0], np.nan), np.hypot(sigma[0], burnt), by_gamma)


def _light(gamma: float) -> npt.NDArray[np.float32]:
    """Light of each pixel value, scaled to 255."""
    return (255.0 * (np.arange(256) / 255.0) ** gamma).astype(np.float32)


def _edge(profiles: FloatArray, offset: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Place of the edge on profiles (n, m), NaN where there is none that is clear; its sigma."""
    start, clear = _crossing(profiles, offset)
    place, sigma = _area_place(profiles, offset, start)
    return np.where(clear & (np.abs(place - start) < 0.7), place, np.nan), sigma


def _crossing(
    profiles: FloatArray, offset: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Half-way crossing of profiles (n, m), and whether it is clear."""
    reach = offset[-1]
    inner = np.median(profiles[:, offset < -0.6 * reach], axis=1)
    outer = np.median(profiles[:, offset > 0.6 * reach], axis=1)
    step = outer - inner
    share = (profiles - inner[:, None]) / np.where(np.abs(step) < 1e-6, 1e-6, step)[:, None]
    # The last place, going outwards, before which everything is still paper.
    beyond = share > 0.5
    first = np.argmax(beyond, axis=1)
    at = np.clip(first, 1, len(offset) - 1)
    rows = np.arange(len(profiles))
    low, high = share[rows, at - 1], share[rows, at]
    place = offset[at - 1] + (0.5 - low) / np.maximum(high - low, 1e-6) * _STEP_PX
    spread = np.std(profiles[:, offset < -0.6 * reach], axis=1)
    # Past the edge a clear profile stays near the level of the wall: no shadow, no neighbour.
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
    """
    Edge of profiles (n, m) that leaves as much area on both sides as they have.

    However sharp the image is, and wherever the edge lies in its pixel, that is unbiased; a
    half-way crossing of a sharp edge is up to 0.09 px off (Tabatabai and Mitchell, PAMI 1984).
    """
    place = np.clip(start, offset[0] + 4.0, offset[-1] - 4.0)
    steps = np.arange(-_CHANGE_PX, _CHANGE_PX + _STEP_PX / 2, _STEP_PX)
    weight = np.full(len(steps), _STEP_PX)
    weight[[0, -1]] *= 0.5
    for _ in range(2):
        inner = _level(profiles, offset, place - _CHANGE_PX - _LEVEL_PX)
        outer = _level(profiles, offset, place + _CHANGE_PX)
        step = np.where(np.abs(outer - inner) < 1.0, 1.0, outer - inner)
        change = _at(profiles, offset, place[:, None] + steps)
        # The area under the share that is wall is what lies between the edge and the far end.
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


# Measurements along each edge, over this share of it: blur rounds the corners.
_PARTS = 5
_SHARE = 0.7
# Edges are looked for so far to both sides of a blob's box, at first and then.
_REACH_PX = (13.0, 7.0)
# The least share of an edge that is found, and how far what is found may lie off one line.
_LEAST_FOUND, _MOST_SPREAD_PX = 0.55, 1.0
# What all points of an edge share: shadows, blur, chroma of half the resolution.
_EDGE_SIGMA_PX = 0.15
# Usual response of a camera to light, and its standard deviation.
_GAMMA, _GAMMA_SIGMA = 1.4, 0.4


@dataclass(frozen=True, eq=False)
class PaperOutlines:
    """
    Sheets of one colour that a panorama shows, arrays over n sheets.

    `azimuth_rad` (n, 2) of their right and left edges in the base frame, right first, unwrapped;
    `tangent` (n, 2) of the elevation of their bottoms and tops at the middle azimuth; `sigma`
    (n, 4) of right, left, bottom, top; `by_response` (n, 4) how far all edges lie farther outwards
    if the camera's response is off by its standard deviation; `misfit` (n,) of their hues in
    squared standard deviations.
    """

    azimuth_rad: FloatArray
    tangent: FloatArray
    sigma: FloatArray
    by_response: FloatArray
    misfit: FloatArray

    def __len__(self) -> int:
        """Return how many sheets there are."""
        return len(self.misfit)


def outline_blobs(view: CylinderImage, color: str, blobs: PaperBlobs) -> PaperOutlines:
    """
    Measure the edges of the blobs of a colour that have four clear ones.

    Parameters
    ----------
    view : CylinderImage
        A sweep as a cylinder in the base frame.
    """
    hue = hue_direction(color)
    rows = []
    for azimuth, tangent, width, misfit in zip(
        blobs.azimuth_rad, blobs.tangent, blobs.width_rad, blobs.misfit, strict=True
    ):
        box = np.array([azimuth - 0.5 * width, azimuth + 0.5 * width, *sorted(tangent)])
        outline = _outline(view, hue, box)
        if outline is not None:
            rows.append((*outline, float(misfit)))
    table = np.array(rows).reshape(-1, 13)
    table = table[_distinct(table)]
    return PaperOutlines(table[:, :2], table[:, 2:4], table[:, 4:8], table[:, 8:12], table[:, 12])


def _outline(view: CylinderImage, hue: FloatArray, box: FloatArray) -> tuple[float, ...] | None:
    """Right, left, bottom, top (azimuths, tangents), sigmas, response; None without four edges."""
    cylinder = view.cylinder
    sigma = by_gamma = np.zeros(4)
    for reach in _REACH_PX:
        image, start = _part(view, box, reach + 6.0)
        right, left = cylinder.cx - cylinder.fx * box[:2] - start[0]
        bottom, top = cylinder.row_of(box[2:]) - start[1]
        if right - left < 4.0 or bottom - top < 4.0:
            return None
        half_x, half_y = 0.5 * (right - left), 0.5 * (bottom - top)
        middle = np.array([left + half_x, top + half_y])
        along = np.linspace(-_SHARE, _SHARE, _PARTS * PROFILES)
        flat = np.zeros_like(along)
        sides = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        offsets = np.concatenate(
            [
                np.stack([flat + side * half_x, along * half_y], 1)
                if side
                else np.stack([along * half_x, flat + down * half_y], 1)
                for side, down in sides
            ]
        )
        outwards = np.repeat(sides, len(along), axis=0)
        inner = min(reach, max(5.0, 1.2 * min(half_x, half_y)))
        found = locate_edges(image, middle + offsets, outwards, hue, inner, _GAMMA, np.inf)
        own = np.hypot(found.sigma_px, _GAMMA_SIGMA * np.abs(found.by_gamma))
        shift, sigma, by_gamma = _lines(found.offset_px, own, found.by_gamma)
        if not np.isfinite(shift).all():
            return None
        # Columns grow clockwise, rows downwards.
        box = box + np.array([-1.0, 1.0, -1.0, 1.0]) * shift / [
            cylinder.fx, cylinder.fx, cylinder.fy, cylinder.fy
        ]  # fmt: skip
    by_response = _GAMMA_SIGMA * by_gamma
    return (*box.tolist(), *(np.concatenate([sigma, by_response]) / cylinder.fx).tolist())


def _lines(
    offset_px: FloatArray, sigma_px: FloatArray, by_gamma: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Middles (4,) of lines through what was found of four edges in turn, sigmas, slopes by gamma.

    By colour (row 0) or, if that shows less, by brightness; NaN where there is no clear line.
    """
    along = np.tile(np.linspace(-1.0, 1.0, _PARTS), 4).reshape(4, _PARTS)
    middle, sigma, slope = (np.full(4, np.nan) for _ in range(3))
    for edge in range(4):
        for offsets, own, slopes in zip(
            *(v.reshape(2, 4, _PARTS)[:, edge] for v in (offset_px, sigma_px, by_gamma)),
            strict=True,
        ):
            good = np.isfinite(offsets)
            if good.mean() < _LEAST_FOUND:
                continue
            design = np.stack([np.ones(int(good.sum())), along[edge, good]], 1)
            line, *_ = np.linalg.lstsq(design, offsets[good], rcond=None)
            spread = float(np.sqrt(np.mean((offsets[good] - design @ line) ** 2)))
            if spread > _MOST_SPREAD_PX:
                continue
            middle[edge] = line[0]
            scatter = np.hypot(spread, np.mean(own[good])) / np.sqrt(good.sum())
            sigma[edge] = np.hypot(_EDGE_SIGMA_PX, scatter)
            slope[edge] = slopes[good].mean()
            break
    return middle, sigma, slope


def _part(view: CylinderImage, box: FloatArray, margin_px: float) -> tuple[ImageArray, FloatArray]:
    """The part of a panorama around a box, across its seam too, and its first column and row."""
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
    """Rows of outlines (n, 13) of which no two are of one sheet."""
    kept: list[int] = []
    for k in np.argsort(table[:, 12], kind='stable').tolist():
        if all(np.abs(table[k, :4] - table[j, :4]).max() > 0.01 for j in kept):
            kept.append(k)
    return kept
