"""The rays of a camera's pixels in square tiles, and linear forms on them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import Float32Array
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.types import FloatArray, ImageArray

# Pixels are worked on in square tiles: what a tile does not show is skipped.
TILE_PX = 32


class RayTiles:
    """The rays of all pixels, tile by tile, and tests of whole tiles."""

    def __init__(self, camera: CameraModel) -> None:
        """Compute the rays once."""
        self._shape = (camera.height, camera.width)
        self._focal_px = camera.fx
        self._rows = -(-camera.height // TILE_PX)
        self._columns = -(-camera.width // TILE_PX)
        grid = np.ones((self._rows * TILE_PX, self._columns * TILE_PX, 3), np.float32)
        pad = [(0, grid.shape[0] - camera.height), (0, grid.shape[1] - camera.width), (0, 0)]
        grid[..., :2] = np.pad(camera.ray_grid, pad, mode='edge')
        tiles = grid.reshape(self._rows, TILE_PX, self._columns, TILE_PX, 3)
        self.rays = np.ascontiguousarray(tiles.transpose(0, 2, 4, 1, 3)).reshape(
            -1, 3, TILE_PX * TILE_PX
        )
        self.count = len(self.rays)
        low, high = self.rays.min(axis=2)[:, :2], self.rays.max(axis=2)[:, :2]
        self._middle = np.ones((self.count, 3))
        self._middle[:, :2] = 0.5 * (low + high)
        self._half = 0.5 * (high - low).astype(np.float64)

    def classify(
        self, forms: FloatArray, spread_px: FloatArray
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """
        Which tiles (surfaces, tiles) a surface may touch, and which it covers whole.

        A linear form on a tile is largest and smallest at the tile's bounding corners.
        """
        edges = edge_forms(forms, self._focal_px)
        value = edges @ self._middle.T + spread_px[..., None]
        reach = np.abs(edges[..., :2]) @ self._half.T
        # What is seen from behind is NaN, and NaN is not greater than anything.
        touched = np.all(value + reach > -0.5, axis=1)
        return touched, np.all(value - reach > 0.5, axis=1)

    def assemble(self, canvas: ImageArray) -> ImageArray:
        """Image out of tiles."""
        rows, columns = self._rows * TILE_PX, self._columns * TILE_PX
        tiles = canvas.reshape(self._rows, self._columns, TILE_PX, TILE_PX, 3)
        image = tiles.transpose(0, 2, 1, 3, 4).reshape(rows, columns, 3)
        return np.ascontiguousarray(image[: self._shape[0], : self._shape[1]])


def edge_forms(forms: FloatArray, focal_px: float) -> FloatArray:
    """Forms (n, 4, 3) whose value on a ray is the distance inside top, right, foot, left, px."""
    w, a, b = forms[:, 0], forms[:, 1], forms[:, 2]
    edges = np.stack([b, w - a, w - b, a], axis=1)
    scale = focal_px / np.linalg.norm(edges[..., :2], axis=-1, keepdims=True)
    return np.asarray(edges * scale)


def coverage(
    form: FloatArray, spread_px: FloatArray, rays: Float32Array, focal_px: float
) -> Float32Array:
    """Share (tiles, side, side) of each pixel that lies inside the rectangle."""
    edges = edge_forms(form[None], focal_px)[0].astype(np.float32)
    inside = edges @ rays + spread_px.astype(np.float32)[:, None]
    share = np.clip(inside + 0.5, 0.0, 1.0)
    # At a corner the shares along the two directions multiply.
    both = np.minimum(share[:, 0], share[:, 2]) * np.minimum(share[:, 1], share[:, 3])
    return np.asarray(both, dtype=np.float32).reshape(-1, TILE_PX, TILE_PX)
