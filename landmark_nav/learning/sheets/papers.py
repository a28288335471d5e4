"""Coloured papers in a panorama, wherever they hang: their height gives their distance."""

from __future__ import annotations

import numpy as np

from landmark_nav.learning.panorama import CylinderImage
from landmark_nav.learning.reference_area.blobs import color_blobs
from landmark_nav.learning.reference_area.edges import outline_blobs
from landmark_nav.learning.sheets.config import SheetsConfig
from landmark_nav.learning.sheets.view import SheetView
from landmark_nav.types import FloatArray, Panorama

# Shape of what may be a paper, width by height, as a share of that of the sheet: seen from the
# side it is narrower. Blobs are rough, outlines are not.
_ROUGHLY, _NARROWEST, _WIDEST = 1.3, 0.2, 1.05
# As near or far as this a paper is not measured, metres.
_NEAREST_M, _FARTHEST_M = 0.3, 12.0


def find_papers(panorama: Panorama, config: SheetsConfig) -> list[SheetView]:
    """Find what may be a paper: a blob of its colour with four clear edges and its shape."""
    view = CylinderImage(panorama.image, panorama.mask, panorama.cylinder)
    shape = config.paper_width_m / config.paper_height_m
    colors = config.paper_colors.split()
    found = []
    for color, blobs in color_blobs(view, colors).items():
        if color not in colors:
            continue
        height = np.abs(np.ptp(blobs.tangent, axis=1))
        share = blobs.width_rad / np.maximum(height, 1e-9) / shape
        reach = config.paper_height_m / np.maximum(height, 1e-9)
        near = (reach > _NEAREST_M / _ROUGHLY) & (reach < _FARTHEST_M * _ROUGHLY)
        likely = (share > _NARROWEST / _ROUGHLY) & (share < _WIDEST * _ROUGHLY) & near
        outlines = outline_blobs(view, color, blobs.only(likely))
        for azimuth, tangent, sigma, by_response in zip(
            outlines.azimuth_rad,
            outlines.tangent,
            outlines.sigma,
            outlines.by_response,
            strict=True,
        ):
            seen = np.ptp(azimuth) / np.ptp(tangent) / shape
            reach_m = config.paper_height_m / np.ptp(tangent)
            if _NARROWEST < seen < _WIDEST and _NEAREST_M < reach_m < _FARTHEST_M:
                position, by_edge = _located(azimuth, tangent, config.paper_height_m)
                own = by_edge * sigma
                # Outwards is to the right (less azimuth), to the left, down and up.
                response = by_edge @ (by_response * [-1.0, 1.0, -1.0, 1.0])
                shared = np.stack([config.size_sigma * position, response], 1)
                found.append(SheetView('papers', color, position, own @ own.T, shared))
    return found


def _located(
    azimuth: FloatArray, tangent: FloatArray, height_m: float
) -> tuple[FloatArray, FloatArray]:
    """
    Middle (3,) of an upright sheet and its derivative (3, 4) by right, left, bottom and top.

    `azimuth` (2,) are its right and left edges, `tangent` (2,) its bottom and top above the middle
    between these.
    """
    middle, (bottom, top) = azimuth.mean(), tangent
    reach = height_m / (top - bottom)
    ray = np.array([np.cos(middle), np.sin(middle), 0.5 * (bottom + top)])
    by_azimuth = 0.5 * reach * np.array([-ray[1], ray[0], 0.0])
    nearer = reach / (top - bottom) * ray
    up = np.array([0.0, 0.0, 0.5 * reach])
    return reach * ray, np.stack([by_azimuth, by_azimuth, up + nearer, up - nearer], 1)
