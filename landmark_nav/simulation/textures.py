"""Procedural textures: noise, plaster, wood and photos; BGR, uint8."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import Float32Array
from landmark_nav.types import ImageArray

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

    The cells of the first octave, down and across, are halved in each octave, and its amplitude is
    multiplied by `persistence`.
    """
    rows, columns = shape
    noise = np.zeros(shape, np.float32)
    for octave in range(octaves):
        grid = (
            int(np.clip(rows * 2**octave / cell_px[0], 2, rows)),
            int(np.clip(columns * 2**octave / cell_px[1], 2, columns)),
        )
        coarse = rng.standard_normal(grid, dtype=np.float32)
        fine = cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC)
        noise += persistence**octave * fine
    noise -= noise.mean()
    return np.asarray(noise / max(float(noise.std()), 1e-6), dtype=np.float32)


def to_uint8(image: npt.NDArray[np.floating]) -> ImageArray:
    """Round and clip to 0 to 255."""
    # Truncation after adding 0.5 rounds values that are not negative.
    return np.asarray(np.clip(image + 0.5, 0.0, 255.0), dtype=np.uint8)


def random_color(
    rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]
) -> Color:
    """A colour (blue, green, red) of random hue, in ranges of saturation and value."""
    hsv = [rng.uniform(0, 180), 255 * rng.uniform(*saturation), 255 * rng.uniform(*value)]
    bgr = cv2.cvtColor(np.array([[hsv]]).astype(np.uint8), cv2.COLOR_HSV2BGR)[0, 0]
    return tuple(bgr.astype(float).tolist())


def plaster(
    rng: np.random.Generator, shape: tuple[int, int], color: Color, texel_m: float
) -> ImageArray:
    """Painted plaster (rows, columns, 3): weak, mottled texture around `color`."""
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
    """Wood (rows, columns, 3) with horizontal grain; planks of width `plank_m` if that is set."""
    grain = fractal_noise(rng, shape, (0.03 / texel_m, 0.9 / texel_m), 4, 0.7)
    rings = np.sin(6.0 * fractal_noise(rng, shape, (0.15 / texel_m, 2.0 / texel_m), 2, 0.4))
    relief = 1.0 + 0.09 * grain + 0.05 * rings.astype(np.float32)
    if plank_m > 0.0:
        plank = np.arange(shape[0]) * texel_m / plank_m
        tone = 1.0 + 0.08 * rng.standard_normal(int(plank[-1]) + 1)
        gap = np.where((plank % 1.0) * plank_m < 0.006, 0.55, 1.0)
        relief = relief * (tone[plank.astype(int)] * gap)[:, None]
    return to_uint8(relief[..., None] * np.array(color, np.float32))


Generator = np.random.Generator


def draw_photo(rng: Generator, shape: tuple[int, int]) -> ImageArray:
    """Draw a photo (rows, columns, 3): background, hills, and shaded bodies with details."""
    rows, columns = shape
    scale = min(shape)
    image = np.empty((rows, columns, 3), np.float32)
    top = np.array(random_color(rng, (0.05, 0.5), (0.35, 1.0)), np.float32)
    bottom = np.array(random_color(rng, (0.1, 0.6), (0.2, 0.8)), np.float32)
    ramp = np.linspace(0, 1, rows, dtype=np.float32)[:, None, None]
    image[:] = top + (bottom - top) * ramp
    image *= 1.0 + 0.25 * fractal_noise(rng, shape, (scale / 2, scale / 2), 6, 0.6)[..., None]
    for _ in range(rng.integers(1, 4)):
        _ridge(rng, image)
    for _ in range(rng.integers(5, 12)):
        _body(rng, image)
    if rng.random() < 0.6:
        _blossom(rng, image)
    image += 5.0 * fractal_noise(rng, shape, (scale / 40, scale / 40), 2)[..., None]
    return to_uint8(image)


def _ridge(rng: Generator, image: np.ndarray) -> None:
    """A skyline of hills or roofs across the image."""
    rows, columns = image.shape[:2]
    profile = fractal_noise(rng, (2, columns), (2, columns / 3), 6, 0.55)[0]
    if rng.random() < 0.4:
        steps = np.arange(columns) // int(columns / rng.integers(8, 25))
        profile = rng.standard_normal(int(steps.max()) + 1)[steps]
    height = rows * (rng.uniform(0.35, 0.8) + 0.09 * profile)
    mask = np.arange(rows)[:, None] > height[None, :]
    color = np.array(random_color(rng, (0.05, 0.5), (0.1, 0.8)), np.float32)
    grain = fractal_noise(rng, (rows, columns), (rows / 6, columns / 9), 6, 0.75)
    image[mask] = (color * (1.0 + 0.35 * grain[..., None]))[mask]


def _body(rng: Generator, image: np.ndarray) -> None:
    """A shaded ellipse or polygon with a few details."""
    rows, columns = image.shape[:2]
    center = rng.uniform(0.1, 0.9, 2) * [columns, rows]
    radius = rng.uniform(0.05, 0.22, 2) * min(rows, columns)
    angle = float(rng.uniform(0, 180))
    reach = int(1.5 * max(radius)) + 2
    low = np.maximum(center.astype(int) - reach, 0)
    high = np.minimum(center.astype(int) + reach, [columns, rows])
    part = image[low[1] : high[1], low[0] : high[0]]
    mask = np.zeros(part.shape[:2], np.uint8)
    inner = center - low
    if rng.random() < 0.6:
        size = (int(radius[0]) + 1, int(radius[1]) + 1)
        where = (round(inner[0]), round(inner[1]))
        cv2.ellipse(mask, where, size, angle, 0, 360, 255, -1, cv2.LINE_AA)
    else:
        corners = cv2.boxPoints((inner.tolist(), (2 * radius).tolist(), angle))
        corners = corners + rng.uniform(-0.4, 0.4, (4, 2)) * radius
        cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 255, cv2.LINE_AA)
    light = rng.uniform(-1, 1, 2) / max(radius)
    x, y = np.arange(part.shape[1]) - inner[0], np.arange(part.shape[0]) - inner[1]
    shade = np.clip(0.8 + 0.4 * (x * light[0] + y[:, None] * light[1]), 0.25, 1.4)
    color = np.array(random_color(rng, (0.1, 0.8), (0.15, 1.0)))
    part += (mask[..., None] / 255.0) * (color * shade[..., None] - part)
    for _ in range(rng.integers(1, 5)):
        x_spot, y_spot = center + rng.uniform(-0.6, 0.6, 2) * radius
        dot = max(2, int(rng.uniform(0.08, 0.3) * min(radius)))
        tone = random_color(rng, (0.0, 0.8), (0.0, 1.0))
        cv2.circle(image, (round(x_spot), round(y_spot)), dot, tone, -1, cv2.LINE_AA)


def _blossom(rng: Generator, image: np.ndarray) -> None:
    """Petals around a centre."""
    rows, columns = image.shape[:2]
    center = rng.uniform(0.3, 0.7, 2) * [columns, rows]
    petals = int(rng.integers(7, 16))
    color = np.array(random_color(rng, (0.4, 0.9), (0.6, 1.0)))
    for ring in np.linspace(1.0, 0.25, int(rng.integers(2, 5))):
        reach = ring * 0.3 * min(rows, columns)
        tone = tuple((color * rng.uniform(0.55, 1.1)).tolist())
        for angle in np.arange(petals) * 2 * np.pi / petals + rng.uniform(0, 1):
            at = center + 0.6 * reach * np.array([np.cos(angle), np.sin(angle)])
            size = (max(1, int(0.45 * reach)), max(1, int(1.6 * reach / petals)))
            where = (round(at[0]), round(at[1]))
            cv2.ellipse(image, where, size, np.degrees(angle), 0, 360, tone, -1, cv2.LINE_AA)
