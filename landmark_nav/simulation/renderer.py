"""Rendering of a scene with a lens model, and effects of lens and sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import Float32Array, IndexArray
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.parameters import Config
from landmark_nav.simulation.scene import Scene
from landmark_nav.simulation.solids import (
    back_to_front,
    background_surfaces,
    box_solid,
    Solid,
    wall_solids,
)
from landmark_nav.simulation.surfaces import light_of, Pyramid, Surface, values_of
from landmark_nav.types import FloatArray, ImageArray

# Side of the square tiles in which pixels are processed; surfaces outside a tile are skipped.
TILE_PX = 32


class RayTiles:
    """The rays of all pixels in tiles, and visibility tests for whole tiles."""

    def __init__(self, camera: CameraModel) -> None:
        self._shape = (camera.height, camera.width)
        self._focal_px = camera.fx
        self._rows = -(-camera.height // TILE_PX)
        self._columns = -(-camera.width // TILE_PX)
        grid = np.ones((self._rows * TILE_PX, self._columns * TILE_PX, 3), np.float32)
        pad = [(0, grid.shape[0] - camera.height), (0, grid.shape[1] - camera.width), (0, 0)]
        grid[..., :2] = np.pad(camera.ray_grid, pad, mode='edge')
        tiles = grid.reshape(self._rows, TILE_PX, self._columns, TILE_PX, 3)
        tiles = np.ascontiguousarray(tiles.transpose(0, 2, 4, 1, 3))
        self.rays = tiles.reshape(-1, 3, TILE_PX * TILE_PX)
        self.count = len(self.rays)
        low, high = self.rays.min(axis=2)[:, :2], self.rays.max(axis=2)[:, :2]
        self._middle = np.ones((self.count, 3))
        self._middle[:, :2] = 0.5 * (low + high)
        self._half = 0.5 * (high - low).astype(np.float64)

    def classify(
        self, forms: FloatArray, spread_px: FloatArray
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """
        Tiles (surfaces, tiles) that a surface may touch, and tiles that it covers completely.

        Extremes of a linear form on a tile are at the corners of its bounding box.
        """
        edges = edge_forms(forms, self._focal_px)
        value = edges @ self._middle.T + spread_px[..., None]
        reach = np.abs(edges[..., :2]) @ self._half.T
        # Surfaces seen from behind are NaN, for which comparisons are false.
        touched = np.all(value + reach > -0.5, axis=1)
        return touched, np.all(value - reach > 0.5, axis=1)

    def assemble(self, canvas: ImageArray) -> ImageArray:
        """Assemble the image from tiles."""
        rows, columns = self._rows * TILE_PX, self._columns * TILE_PX
        tiles = canvas.reshape(self._rows, self._columns, TILE_PX, TILE_PX, 3)
        image = tiles.transpose(0, 2, 1, 3, 4).reshape(rows, columns, 3)
        return np.ascontiguousarray(image[: self._shape[0], : self._shape[1]])


def edge_forms(forms: FloatArray, focal_px: float) -> FloatArray:
    """Forms (n, 4, 3): distance of a ray inside the top, right, bottom and left edge, pixels."""
    w, a, b = forms[:, 0], forms[:, 1], forms[:, 2]
    edges = np.stack([b, w - a, w - b, a], axis=1)
    scale = focal_px / np.linalg.norm(edges[..., :2], axis=-1, keepdims=True)
    return np.asarray(edges * scale)


def coverage(
    form: FloatArray, spread_px: FloatArray, rays: Float32Array, focal_px: float
) -> Float32Array:
    """Share (tiles, side, side) of each pixel inside the rectangle."""
    edges = edge_forms(form[None], focal_px)[0].astype(np.float32)
    inside = edges @ rays + spread_px.astype(np.float32)[:, None]
    share = np.clip(inside + 0.5, 0.0, 1.0)
    # At a corner the shares along the two directions multiply.
    both = np.minimum(share[:, 0], share[:, 2]) * np.minimum(share[:, 1], share[:, 3])
    return np.asarray(both, dtype=np.float32).reshape(-1, TILE_PX, TILE_PX)


# Side of the cells of pixels that have a common level of detail.
_CELL_PX = 4
# Offset of the level of detail, octaves: slightly finer than one texel per pixel.
_SHARPNESS = -0.35


def sample_texture(
    pyramid: Pyramid, form: FloatArray, rays: Float32Array, focal_px: float
) -> ImageArray:
    """Colours (tiles, side, side, channels) of a surface at `rays` (tiles, 3, n)."""
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
    """Levels of the pyramid for cells, each (tiles, cells, cells), by the texels per pixel."""
    # The derivative of (a r) / (w r) along x is (a_x - u w_x) / (w r).
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
    """Texture at `place` (tiles, 2, cells, cell, cells, cell) at the levels of the cells."""
    scale = np.moveaxis(pyramid.scale[slant, level], -1, 1)[:, :, :, None, :, None]
    offset = np.moveaxis(pyramid.offset[slant, level], -1, 1)[:, :, :, None, :, None]
    # Pixels at the border may be outside of the texture by one texel of their level.
    inside = np.clip(place, -1.0 / scale, 1.0 + 1.0 / scale)
    xy = inside * scale + offset
    # One row for each tile: OpenCV does not support maps of 32767 rows or more.
    map_x, map_y = (xy[:, k].reshape(len(xy), -1) for k in (0, 1))
    texels = cv2.remap(pyramid.atlas, map_x, map_y, cv2.INTER_LINEAR)
    return np.asarray(texels, dtype=np.uint8).reshape(len(xy) * TILE_PX, TILE_PX, -1)


class Renderer:
    """
    Renders a scene.

    The ray of each pixel is intersected with textured rectangles by three linear forms, without an
    intermediate image: points of walls appear exactly where `CameraModel` projects them.
    Rectangles are painted from the farthest to the nearest, weighted by the share of each pixel
    that they cover.
    """

    def __init__(self, scene: Scene, camera: CameraModel) -> None:
        """Draw the textures; takes seconds."""
        self.scene = scene
        self.camera = camera
        self._solids = wall_solids(scene) + [box_solid(box) for box in scene.boxes]
        self._ground = background_surfaces(scene)
        self._pyramids: dict[int, tuple[ImageArray, Pyramid]] = {}
        self._tiles = RayTiles(camera)
        self._lamps = scene.lamps

    def render(
        self, rotation: FloatArray, center: FloatArray, people: Sequence[Solid] = ()
    ) -> ImageArray:
        """
        Render one image, BGR, without vignetting and noise.

        `rotation` is from the optical frame to map, `center` the optical centre there.
        """
        solids = [*self._solids, *people]
        surfaces = self._ground + [s for solid in solids for s in solid.surfaces]
        group = np.repeat(
            np.arange(-1, len(solids)),
            [len(self._ground), *(len(solid.surfaces) for solid in solids)],
        )
        forms = _ray_forms(surfaces, rotation, center)
        touched, _ = self._tiles.classify(forms, np.zeros((len(surfaces), 4)))
        seen = np.flatnonzero(touched.any(axis=1))
        visible = np.unique(group[seen][group[seen] >= 0])
        rank = np.full(len(solids) + 1, -1)
        heading = float(np.arctan2(rotation[1, 2], rotation[0, 2]))
        farthest = back_to_front([solids[k].footprint for k in visible], center[:2], heading)
        rank[visible[farthest]] = np.arange(len(visible))
        order = seen[np.lexsort((seen, rank[group[seen]]))]
        chosen = [surfaces[k] for k in order]
        return self._paint(chosen, forms[order], _overlaps(chosen))

    def _paint(
        self, surfaces: list[Surface], forms: FloatArray, spread_px: FloatArray
    ) -> ImageArray:
        """Paint surfaces in order, with their `forms` (n, 3, 3) and `spread_px` (n, 4)."""
        touched, covered = self._tiles.classify(forms, spread_px)
        opaque = np.array([s.albedo.shape[2] == 3 for s in surfaces])
        last = np.where(covered & opaque[:, None], np.arange(len(surfaces))[:, None], 0).max(0)
        canvas = np.zeros((self._tiles.count, TILE_PX, TILE_PX, 3), np.uint8)
        for k, surface in enumerate(surfaces):
            tiles = np.flatnonzero(touched[k] & (last <= k))
            if not len(tiles):
                continue
            rays = self._tiles.rays[tiles]
            color = sample_texture(self._pyramid(surface), forms[k], rays, self.camera.fx)
            partial = ~(covered[k, tiles] & opaque[k])
            canvas[tiles[~partial]] = color[~partial, ..., :3]
            if partial.any():
                edge = tiles[partial]
                share = coverage(forms[k], spread_px[k], rays[partial], self.camera.fx)
                canvas[edge] = _blend(canvas[edge], color[partial], share)
        return self._tiles.assemble(canvas)

    def _pyramid(self, surface: Surface) -> Pyramid:
        """Illuminated pyramid of a surface, computed when it is first visible."""
        key = id(surface.albedo)
        if key not in self._pyramids:
            # A reference to the texture is kept, so that its id is not reused.
            self._pyramids[key] = (surface.albedo, surface.illuminated(self._lamps))
        return self._pyramids[key][1]


def _ray_forms(
    surfaces: Sequence[Surface], rotation: FloatArray, center: FloatArray
) -> FloatArray:
    """Linear forms (n, 3, 3) of a ray r in the optical frame."""
    # With rows w, a, b the ray meets the plane at depth 1 / (w r), at texture coordinates (a r) /
    # (w r) and (b r) / (w r) in [0, 1]. NaN for surfaces seen from behind.
    corner = np.array([s.corner for s in surfaces]) - center
    across = np.array([s.across for s in surfaces])
    down = np.array([s.down for s in surfaces])
    inward = np.cross(across, down)
    distance = np.sum(inward * corner, -1)[:, None]
    distance[distance < 1e-6] = np.nan
    w = inward / distance
    a = across - np.sum(across * corner, -1)[:, None] * w
    b = down - np.sum(down * corner, -1)[:, None] * w
    a /= np.array([s.width_m for s in surfaces])[:, None]
    b /= np.array([s.height_m for s in surfaces])[:, None]
    return np.asarray(np.stack([w, a, b], axis=1) @ rotation)


def _overlaps(surfaces: list[Surface]) -> FloatArray:
    """Extension (n, 4) of each edge, pixels."""
    # If two surfaces share an edge, the first is extended below the second; otherwise the
    # background would be visible at the seam.
    corners = np.array([s.corners for s in surfaces])
    middle = 0.5 * (corners + np.roll(corners, -1, axis=1))
    gap = np.abs(middle[:, :, None, None] - middle[None, None]).max(-1)
    shared = (gap < 2e-3).any(axis=-1)
    later = np.arange(len(surfaces))[:, None] < np.arange(len(surfaces))[None]
    return np.where((shared & later[:, None, :]).any(axis=-1), 1.0, 0.0)


def _blend(under: ImageArray, color: ImageArray, share: Float32Array) -> ImageArray:
    """Blend `color` over `under` by the covered share; both (tiles, side, side, channels)."""
    if color.shape[-1] == 4:
        share = share * (color[..., 3] * np.float32(1.0 / 255.0))
    weight = share[..., None]
    top, below = light_of(color[..., :3]), light_of(under)
    return values_of((weight * top + (1.0 - weight) * below).astype(np.uint16))


@dataclass(frozen=True)
class CameraEffectsConfig(Config):
    """Errors of the camera; brightness in grey levels of 255."""

    # Share of light lost in the corners.
    vignetting: float = 0.25
    # Strength of auto exposure: 0 constant gain, 1 constant mean brightness.
    auto_exposure: float = 0.5
    target_brightness: float = 120.0
    # Gaussian point spread of lens and sensor, pixels.
    blur_sigma_px: float = 0.5
    # Standard deviation of noise in the dark, grey levels.
    read_noise: float = 2.0
    # Variance of noise per brightness, grey levels.
    shot_noise: float = 0.06


class CameraEffects:
    """
    Applies blur, vignetting, exposure and noise to clean images.

    Noise is cut out of one large field at random positions: much faster than drawing it for each
    frame, and still different from frame to frame.
    """

    def __init__(
        self, camera: CameraModel, config: CameraEffectsConfig, rng: np.random.Generator
    ) -> None:
        self._config = config
        self._rng = rng
        square = np.sum(camera.ray_grid.astype(np.float64) ** 2, -1)
        falloff = 1.0 - config.vignetting * square / square.max()
        self._vignette = np.repeat(falloff.astype(np.float32)[..., None], 3, axis=2)
        field = (2 * camera.height + 64, camera.width + 512, 3)
        self._noise = rng.standard_normal(field, dtype=np.float32)
        level = np.arange(256, dtype=np.float32)
        self._sigma = np.sqrt(config.read_noise**2 + config.shot_noise * level).astype(np.float32)

    def apply(self, image: ImageArray) -> ImageArray:
        """Return the image (height, width, 3), BGR, with the effects."""
        config = self._config
        if config.blur_sigma_px > 0.0:
            sigma = config.blur_sigma_px
            side = 2 * int(np.ceil(2.5 * sigma)) + 1
            blurred = cv2.GaussianBlur(light_of(image), (side, side), sigma)
            image = values_of(np.asarray(blurred, np.uint16))
        mean = max(float(image[::8, ::8].mean()), 1.0)
        gain = (config.target_brightness / mean) ** config.auto_exposure
        clean = cv2.multiply(image, self._vignette, scale=gain, dtype=cv2.CV_32F)
        if config.read_noise == 0.0 and config.shot_noise == 0.0:
            return np.clip(np.rint(clean), 0, 255).astype(np.uint8)
        rows, columns = image.shape[:2]
        top = int(self._rng.integers(self._noise.shape[0] - rows + 1))
        left = int(self._rng.integers(self._noise.shape[1] - columns + 1))
        noise = self._noise[top : top + rows, left : left + columns]
        sigma_map = cv2.LUT(cv2.convertScaleAbs(clean), self._sigma)
        noisy = cv2.add(clean, cv2.multiply(noise, sigma_map), dtype=cv2.CV_8U)
        return np.asarray(noisy, dtype=np.uint8)
