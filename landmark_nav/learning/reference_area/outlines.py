"""
Outlines of coloured sheets in a panorama, wherever room.yaml says that papers hang.

A sheet on a wall has two upright edges, which are columns of the panorama, and two level ones.
What is measured here knows nothing of where papers should hang: it shows which of them does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.panorama import CylinderImage
from landmark_nav.learning.reference_area.blobs import hue_direction, PaperBlobs
from landmark_nav.learning.reference_area.edges import locate_edges, PROFILES
from landmark_nav.types import FloatArray, ImageArray

__all__ = ['PaperOutlines', 'outline_blobs']

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
    color : str
        Of the papers.
    blobs : PaperBlobs
        What may be one.

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
