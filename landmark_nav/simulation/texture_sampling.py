"""Colours that rays see on a textured rectangle, averaged over what a pixel covers."""

from __future__ import annotations

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array, IndexArray
from landmark_nav.simulation.ray_tiles import TILE_PX
from landmark_nav.simulation.surfaces import Pyramid
from landmark_nav.types import FloatArray, ImageArray

__all__ = ['sample_texture']


# The level of detail is chosen once for each cell of this many pixels a side.
_CELL_PX = 4

# Levels of detail a little finer than one texel a pixel: as sharp as a good lens.
_SHARPNESS = -0.35


def sample_texture(
    pyramid: Pyramid, form: FloatArray, rays: Float32Array, focal_px: float
) -> ImageArray:
    """Colours (tiles, side, side, channels) that a surface shows to `rays` (tiles, 3, n)."""
    n, cells = len(rays), TILE_PX // _CELL_PX
    projected = form.astype(np.float32) @ rays
    with np.errstate(divide='ignore', invalid='ignore'):
        inverse = np.float32(1.0) / np.maximum(projected[:, 0], np.float32(1e-6))
    place = projected[:, 1:] * inverse[:, None]
    grid = place.reshape(n, 2, TILE_PX, TILE_PX)
    half = _CELL_PX // 2
    depth = inverse.reshape(n, TILE_PX, TILE_PX)[:, half::_CELL_PX, half::_CELL_PX]
    slant, level, share = _level_of_detail(
        pyramid, form, grid[:, :, half::_CELL_PX, half::_CELL_PX], depth / focal_px
    )
    split = place.reshape(n, 2, cells, _CELL_PX, cells, _CELL_PX)
    fine, coarse = (
        _look_up(pyramid, split, slant, np.minimum(level + k, pyramid.scale.shape[1] - 1))
        for k in (0, 1)
    )
    weight = np.repeat(np.repeat(share, _CELL_PX, axis=1), _CELL_PX, axis=2)
    weight = weight.reshape(-1, TILE_PX)
    mixed = cv2.blendLinear(fine, coarse, 1.0 - weight, weight)
    return np.asarray(mixed, dtype=np.uint8).reshape(n, TILE_PX, TILE_PX, -1)


def _level_of_detail(
    pyramid: Pyramid, form: FloatArray, place: Float32Array, depth_per_px: Float32Array
) -> tuple[IndexArray, IndexArray, Float32Array]:
    """
    Levels of the pyramid for cells, each (tiles, cells, cells), from how texels spread.

    The derivative of (a r) / (w r) along x is (a_x - u w_x) / (w r).
    """
    w, a, b = form.astype(np.float32)
    octaves = []
    for k, row in enumerate((a, b)):
        spread = np.hypot(row[0] - place[:, k] * w[0], row[1] - place[:, k] * w[1])
        texels = spread * depth_per_px * pyramid.size_texels[k]
        octaves.append(np.log2(np.maximum(texels, 1e-3)))
    across, down = octaves
    slants, levels = pyramid.scale.shape[:2]
    slant = np.clip(np.rint(across - down), 0, slants - 1)
    octave = np.clip(0.5 * (across - slant + down) + _SHARPNESS, 0.0, levels - 1.0)
    level = np.minimum(np.floor(octave), levels - 2)
    return slant.astype(np.intp), level.astype(np.intp), (octave - level).astype(np.float32)


def _look_up(
    pyramid: Pyramid, place: Float32Array, slant: IndexArray, level: IndexArray
) -> ImageArray:
    """Texture at `place` (tiles, 2, cells, cell, cells, cell) in the levels of its cells."""
    scale = np.moveaxis(pyramid.scale[slant, level], -1, 1)[:, :, :, None, :, None]
    offset = np.moveaxis(pyramid.offset[slant, level], -1, 1)[:, :, :, None, :, None]
    # Outside the rectangle, where coverage ends: one border texel of its own level.
    inside = np.clip(place, -1.0 / scale, 1.0 + 1.0 / scale)
    xy = inside * scale + offset
    # A tile a row, as OpenCV takes no map of 32767 rows or more.
    map_x, map_y = (xy[:, k].reshape(len(xy), -1) for k in (0, 1))
    texels = cv2.remap(pyramid.atlas, map_x, map_y, cv2.INTER_LINEAR)
    return np.asarray(texels, dtype=np.uint8).reshape(len(xy) * TILE_PX, TILE_PX, -1)
