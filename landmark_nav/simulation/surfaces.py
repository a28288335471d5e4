"""
Textured rectangles, their pyramids of averaged copies, and their illumination.

Illumination by lamps depends on cosine and distance; there are no shadows.

Light and grey levels are related by the curve of sRGB (IEC 61966-2-1). Blur, averages and partial
coverage of pixels mix light, not grey levels: blurred edges then appear shifted towards their dark
side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.simulation.scene import Lamp
from landmark_nav.types import FloatArray, ImageArray

# Ambient light as a factor on the albedo.
_AMBIENT = 0.55
# Gain of a lamp of power 1, before the decrease with distance.
_LAMP_GAIN = 1.5
# Added to the squared distance, since lamps are wide: the light is finite beside one.
_LAMP_RADIUS_M = 0.9


def irradiance(points: npt.ArrayLike, normal: npt.ArrayLike, lamps: Sequence[Lamp]) -> FloatArray:
    """
    Illumination of points (..., 3) on a plane: factors on blue, green and red of the albedo.

    They are about 1 in a usual room. The normal is that of the illuminated side.
    """
    at = np.asarray(points, dtype=np.float64)
    light = np.full(at.shape, _AMBIENT)
    for lamp in lamps:
        offset = np.asarray(lamp.position) - at
        square = np.sum(offset**2, -1)
        cosine = np.clip(offset @ np.asarray(normal) / np.sqrt(square + 1e-9), 0.0, 1.0)
        # A wide lamp also illuminates surfaces at grazing angles: a softened cosine.
        strength = _LAMP_GAIN * lamp.power * (0.25 + 0.75 * cosine) / (square + _LAMP_RADIUS_M)
        light += strength[..., None] * np.asarray(lamp.tint)
    return light


LightArray = npt.NDArray[np.uint16]

_MOST = 65535


_SHARE = np.arange(256) / 255.0
_LIGHT = np.where(_SHARE <= 0.04045, _SHARE / 12.92, ((_SHARE + 0.055) / 1.055) ** 2.4)
_LIGHT = np.rint(_MOST * _LIGHT).astype(np.uint16)
# Grey level with the nearest light.
_VALUE = np.searchsorted(0.5 * (_LIGHT[1:] + _LIGHT[:-1].astype(float)), np.arange(_MOST + 1))
_VALUE = _VALUE.astype(np.uint8)


def light_of(values: ImageArray) -> LightArray:
    """Light, 0 to 65535, of grey levels (height, ..., channels); same shape."""
    flat = values.reshape(len(values), -1)
    return np.asarray(cv2.LUT(flat, _LIGHT), dtype=np.uint16).reshape(values.shape)


def values_of(light: LightArray) -> ImageArray:
    """Grey levels of light; same shape."""
    return np.asarray(_VALUE[light], dtype=np.uint8)


# Border around each level, so that interpolation does not reach the next level.
_BORDER_PX = 3
# Step of the grid on which illumination is computed; it is interpolated between.
_LIGHT_STEP_M = 0.15
_LEVELS = 5


@dataclass(frozen=True, eq=False)
class Pyramid:
    """
    A texture reduced by powers of two, across and down independently, in one image.

    Walls seen obliquely need coarser texels across than down; square averages would blur them.
    Level (i, j) is averaged over about 2**(j + i) texels across and 2**j down. Pixel (x, y) in the
    `atlas` of texture coordinate c in [0, 1] is ``c * scale[i, j] + offset[i, j]``, for pixel
    centres at integers.
    """

    atlas: ImageArray
    scale: npt.NDArray[np.float32]
    offset: npt.NDArray[np.float32]
    size_texels: tuple[int, int]

    @classmethod
    def build(cls, texture: ImageArray, slants: int, levels: int) -> Pyramid:
        """Average `texture` for `slants` values of i and `levels` of j."""
        rows, columns = texture.shape[:2]
        scale = np.empty((slants, levels, 2), np.float32)
        offset = np.empty((slants, levels, 2), np.float32)
        pieces: list[tuple[int, int, ImageArray]] = []
        first, y = texture, 0
        for j in range(levels):
            # Each level is the average of the next finer one.
            first = level = _average(first, columns >> j, rows >> j)
            x = 0
            for i in range(slants):
                level = _average(level, columns >> (i + j), rows >> j)
                scale[i, j] = level.shape[1::-1]
                offset[i, j] = (x + _BORDER_PX - 0.5, y + _BORDER_PX - 0.5)
                border = ((_BORDER_PX, _BORDER_PX), (_BORDER_PX, _BORDER_PX), (0, 0))
                pieces.append((x, y, np.pad(level, border, mode='edge')))
                x += pieces[-1][2].shape[1]
            y += pieces[-1][2].shape[0]
        width = max(x + piece.shape[1] for x, _, piece in pieces)
        atlas = np.zeros((y, width, texture.shape[2]), np.uint8)
        for x, top, piece in pieces:
            atlas[top : top + piece.shape[0], x : x + piece.shape[1]] = piece
        return cls(atlas, scale, offset, (columns, rows))


@dataclass(frozen=True, eq=False)
class Surface:
    """
    A rectangle with a texture, seen from one side, from its top left `corner`.

    `across` and `down` (3,) are unit vectors along rows and columns of texels. `albedo` (rows,
    columns, 3 or 4) are colours in usual light, and opacity; it is shown unchanged if lamps do not
    light it. `slants` is the number of levels of foreshortening in the pyramid; 1 for none.
    """

    corner: FloatArray
    across: FloatArray
    down: FloatArray
    width_m: float
    height_m: float
    albedo: ImageArray
    slants: int = 1
    lit: bool = True

    @property
    def normal(self) -> FloatArray:
        """Unit normal of the front, (3,)."""
        return np.asarray(np.cross(self.down, self.across))

    @property
    def corners(self) -> FloatArray:
        """Corners (4, 3), clockwise seen from the front, from the top left one."""
        right, foot = self.width_m * self.across, self.height_m * self.down
        return np.asarray(self.corner + np.array([0 * right, right, right + foot, foot]))

    def illuminated(self, lamps: Sequence[Lamp]) -> Pyramid:
        """Pyramid of the texture in the light of `lamps`."""
        texture = self.albedo
        if self.lit:
            texture = _shade(texture, self._light(lamps))
        return Pyramid.build(texture, self.slants, _LEVELS)

    def _light(self, lamps: Sequence[Lamp]) -> npt.NDArray[np.float32]:
        """Illumination on a coarse grid of cells (rows, columns, 3)."""
        shape = [max(2, round(size / _LIGHT_STEP_M)) for size in (self.height_m, self.width_m)]
        v = (np.arange(shape[0]) + 0.5) / shape[0] * self.height_m
        u = (np.arange(shape[1]) + 0.5) / shape[1] * self.width_m
        points = self.corner + v[:, None, None] * self.down + u[None, :, None] * self.across
        return irradiance(points, self.normal, lamps).astype(np.float32)


def _average(texture: ImageArray, columns: int, rows: int) -> ImageArray:
    """Reduce `texture` to a size by the mean light over the area of each texel."""
    size = (max(1, columns), max(1, rows))
    if size == texture.shape[1::-1]:
        return texture
    mean = np.empty((size[1], size[0], texture.shape[2]), np.uint8)
    light = cv2.resize(light_of(texture[..., :3]), size, interpolation=cv2.INTER_AREA)
    mean[..., :3] = values_of(np.asarray(light, dtype=np.uint16))
    if texture.shape[2] == 4:
        mean[..., 3] = cv2.resize(texture[..., 3], size, interpolation=cv2.INTER_AREA)
    return mean


def _shade(texture: ImageArray, light: npt.NDArray[np.float32]) -> ImageArray:
    """Texture times illumination, in strips to avoid a large float image."""
    shaded = np.empty_like(texture)
    rows, columns = texture.shape[:2]
    across = cv2.resize(light, (columns, len(light)), interpolation=cv2.INTER_LINEAR)
    place = np.clip((np.arange(rows) + 0.5) / rows * len(light) - 0.5, 0.0, len(light) - 1.0)
    low = np.minimum(place.astype(int), len(light) - 2)
    share = (place - low).astype(np.float32)
    for start in range(0, rows, 64):
        part = slice(start, start + 64)
        weight = share[part, None, None]
        factor = across[low[part]] * (1 - weight) + across[low[part] + 1] * weight
        shaded[part] = cv2.multiply(np.ascontiguousarray(texture[part]), factor, dtype=cv2.CV_8U)
    return shaded
