"""Procedural materials: plaster, wood, ceiling and the noise they are made of; BGR, uint8."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import Float32Array
from landmark_nav.types import ImageArray

__all__ = ['fractal_noise', 'plaster', 'random_color', 'to_uint8', 'wood']

Color = tuple[float, float, float]


def fractal_noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cell_px: tuple[float, float],
    octaves: int,
    persistence: float = 0.5,
) -> Float32Array:
    """
    Noise of several octaves, zero mean and unit standard deviation.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness.
    shape : (int, int)
        Rows and columns.
    cell_px : (float, float)
        Size of the coarsest grain down and across, pixels; each octave halves it.
    octaves : int
        How many.
    persistence : float
        Amplitude of an octave relative to the coarser one.

    Returns
    -------
    ndarray of float32, shape `shape`

    """
    rows, columns = shape
    noise = np.zeros(shape, np.float32)
    for octave in range(octaves):
        grid = (
            int(np.clip(rows * 2**octave / cell_px[0], 2, rows)),
            int(np.clip(columns * 2**octave / cell_px[1], 2, columns)),
        )
        coarse = rng.standard_normal(grid, dtype=np.float32)
        noise += persistence**octave * cv2.resize(
            coarse, (columns, rows), interpolation=cv2.INTER_CUBIC
        )
    noise -= noise.mean()
    return np.asarray(noise / max(float(noise.std()), 1e-6), dtype=np.float32)


def to_uint8(image: npt.NDArray[np.floating]) -> ImageArray:
    """Rounded and clipped to 0 to 255."""
    # Adding half and cutting off rounds what is not negative.
    return np.asarray(np.clip(image + 0.5, 0.0, 255.0), dtype=np.uint8)


def random_color(
    rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]
) -> Color:
    """A colour (blue, green, red) of any hue, in the given ranges of saturation and value."""
    hsv = [rng.uniform(0, 180), 255 * rng.uniform(*saturation), 255 * rng.uniform(*value)]
    bgr = cv2.cvtColor(np.array([[hsv]]).astype(np.uint8), cv2.COLOR_HSV2BGR)[0, 0]
    return (float(bgr[0]), float(bgr[1]), float(bgr[2]))


def plaster(
    rng: np.random.Generator, shape: tuple[int, int], color: Color, texel_m: float
) -> ImageArray:
    """Painted plaster (rows, columns, 3): weak, mottled texture about `color`."""
    mottle = fractal_noise(rng, shape, (0.5 / texel_m, 0.5 / texel_m), 5, 0.75)
    grain = fractal_noise(rng, shape, (0.012 / texel_m, 0.012 / texel_m), 2, 0.8)
    relief = 1.0 + 0.018 * mottle + 0.014 * grain
    return to_uint8(relief[..., None] * np.array(color, np.float32))


def wood(
    rng: np.random.Generator,
    shape: tuple[int, int],
    color: Color,
    texel_m: float,
    plank_m: float = 0.0,
) -> ImageArray:
    """Wood with its grain along the columns; laid in planks `plank_m` wide if that is given."""
    grain = fractal_noise(rng, shape, (0.03 / texel_m, 0.9 / texel_m), 4, 0.7)
    rings = np.sin(6.0 * fractal_noise(rng, shape, (0.15 / texel_m, 2.0 / texel_m), 2, 0.4))
    relief = 1.0 + 0.09 * grain + 0.05 * rings.astype(np.float32)
    if plank_m > 0.0:
        plank = np.arange(shape[0]) * texel_m / plank_m
        tone = 1.0 + 0.08 * rng.standard_normal(int(plank[-1]) + 1)
        gap = np.where((plank % 1.0) * plank_m < 0.006, 0.55, 1.0)
        relief = relief * (tone[plank.astype(int)] * gap)[:, None]
    return to_uint8(relief[..., None] * np.array(color, np.float32))
