"""Procedural textures, and the items on walls that are made of them; BGR, uint8."""

from __future__ import annotations

from collections.abc import Callable
import itertools

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import Float32Array
from landmark_nav.geometry.walls import NAMED_HUES_DEG, paper_bgr
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


def draw_item(kind: str, seed: int, shape: tuple[int, int]) -> ImageArray:
    """Draw a kind of `WallItem`, or ``books`` for the side of a bookcase, (rows, columns, 3)."""
    # At twice the size, and averaged.
    twice = 2 * shape[0], 2 * shape[1]
    large = (
        _tag(seed, twice) if kind == 'tag' else _PAINTERS[kind](np.random.default_rng(seed), twice)
    )
    drawn = cv2.resize(large, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return np.asarray(drawn, dtype=np.uint8)


def _poster(rng: Generator, shape: tuple[int, int]) -> ImageArray:
    """A title bar above columns of text and figures."""
    rows, columns = shape
    image = np.empty((rows, columns, 3), np.uint8)
    image[:] = random_color(rng, (0.02, 0.15), (0.85, 1.0))
    title = int(rng.uniform(0.08, 0.16) * rows)
    image[:title] = random_color(rng, (0.3, 0.9), (0.2, 0.6))
    _text_line(rng, image, 0.06 * columns, 0.3 * title, 0.8 * columns, 0.4 * title, (250,) * 3)
    count = int(rng.integers(2, 4)) if columns > 0.6 * rows else 2
    gutter = 0.05 * columns
    width = (columns - gutter * (count + 1)) / count
    line = rows * rng.uniform(0.010, 0.015)
    for k in range(count):
        left, y = gutter + k * (width + gutter), title + 1.5 * line
        while y < rows - 2.5 * line:
            if rng.random() < 0.18:
                height = min(rng.uniform(0.06, 0.14) * rows, rows - 1.5 * line - y)
                _figure(rng, image, left, y, width, height)
                y += height + line
            else:
                _text_line(rng, image, left, y, width, line, (40, 35, 35))
                y += 1.8 * line
    return image


def _text_line(
    rng: Generator,
    image: np.ndarray,
    left: float,
    top: float,
    width: float,
    height: float,
    color: Color,
) -> None:
    """Words as bars: letters would not be resolved at this size."""
    x, right = left, left + width * rng.uniform(0.6, 1.0)
    while x < right:
        word = min(height * rng.uniform(1.2, 5.0), right - x)
        corner = (round(x + word), round(top + height * rng.uniform(0.7, 1.0)))
        cv2.rectangle(image, (round(x), round(top)), corner, color, -1)
        x += word + 0.6 * height


def _figure(
    rng: Generator, image: np.ndarray, left: float, top: float, width: float, height: float
) -> None:
    """A coloured diagram."""
    a, b = (round(left), round(top)), (round(left + width), round(top + height))
    cv2.rectangle(image, a, b, random_color(rng, (0.3, 0.7), (0.4, 0.9)), -1)
    low, span = np.array(a), np.maximum(np.array(b) - a, 4)
    if rng.random() < 0.5:
        points = low + span * rng.uniform(0.08, 0.92, (int(rng.integers(4, 9)), 2))
        points = points[np.argsort(points[:, 0])]
        thick = max(2, int(height / 14))
        line = np.rint(points).astype(np.int32)
        cv2.polylines(image, [line], False, (245,) * 3, thick, cv2.LINE_AA)
    else:
        bars = int(rng.integers(4, 10))
        for k, level in enumerate(rng.uniform(0.15, 0.9, bars)):
            x = low[0] + span[0] * np.array([k + 0.2, k + 0.75]) / bars
            y = low[1] + span[1] * np.array([1.0 - level, 0.96])
            tone = random_color(rng, (0.2, 0.9), (0.2, 1.0))
            cv2.rectangle(image, (round(x[0]), round(y[0])), (round(x[1]), round(y[1])), tone, -1)


def _books(rng: Generator, shape: tuple[int, int]) -> ImageArray:
    """Shelves full of books."""
    rows, columns = shape
    image = np.full((rows, columns, 3), (22, 24, 30), np.uint8)
    frame = max(3, int(0.03 * columns))
    shelves = max(2, round(rows / columns * rng.uniform(2.5, 3.5)))
    board = random_color(rng, (0.3, 0.6), (0.3, 0.5))
    edges = np.linspace(0, rows, shelves + 1).astype(int)
    for low, high in itertools.pairwise(edges):
        x = float(frame)
        while x < columns - 2 * frame:
            width = columns * rng.uniform(0.018, 0.055)
            if rng.random() > 0.06:
                top = low + frame + (high - low) * rng.uniform(0.04, 0.3)
                spine = random_color(rng, (0.1, 0.85), (0.15, 0.85))
                end = min(x + width - 2, columns - frame)
                cv2.rectangle(image, (round(x), round(top)), (round(end), high), spine, -1)
                label = top + (high - top) * rng.uniform(0.1, 0.4)
                tone = random_color(rng, (0.0, 0.4), (0.6, 1.0))
                foot = (round(end) - 2, round(label + (high - low) * rng.uniform(0.05, 0.2)))
                cv2.rectangle(image, (round(x) + 2, round(label)), foot, tone, -1)
            x += width
        cv2.rectangle(image, (0, high - frame), (columns, high), board, -1)
    cv2.rectangle(image, (0, 0), (columns - 1, rows - 1), board, 2 * frame)
    return image


def _target(rng: Generator, shape: tuple[int, int]) -> ImageArray:
    """The specialised target: concentric black rings around a black disc on white."""
    del rng  # The target is the same in every room.
    rows, columns = shape
    y, x = np.mgrid[:rows, :columns]
    radius = np.hypot((x + 0.5) / columns - 0.5, (y + 0.5) / rows - 0.5)
    dark = (radius < 0.49) & ((radius / 0.14) % 1.0 < 0.5)
    image = np.where(dark, 14, 242).astype(np.uint8)
    return np.asarray(np.repeat(image[..., None], 3, axis=2))


def _sheet(rng: Generator, shape: tuple[int, int]) -> ImageArray:
    """A sheet of paper of one vivid colour."""
    color = paper_bgr(str(rng.choice(list(NAMED_HUES_DEG))))
    return np.tile(np.rint(color).astype(np.uint8), (*shape, 1))


def _blinds(rng: Generator, shape: tuple[int, int]) -> ImageArray:
    """A window behind closed blinds, in a dark frame."""
    rows, columns = shape
    slats = int(rng.integers(18, 30))
    phase = (np.arange(rows) / rows * slats) % 1.0
    tone = np.where(phase < 0.12, 95.0, 205.0 - 50.0 * phase) * rng.uniform(0.9, 1.1)
    image = np.repeat(np.repeat(tone[:, None, None], columns, 1), 3, 2)
    image *= 1.0 + 0.02 * fractal_noise(rng, shape, (rows / 2, columns / 4), 3)[..., None]
    drawing = to_uint8(image)
    for x in rng.uniform(0.1, 0.9, int(rng.integers(2, 4))) * columns:
        cv2.line(drawing, (round(x), 0), (round(x), rows), (70, 70, 70), 4)
    cv2.rectangle(drawing, (0, 0), (columns - 1, rows - 1), (48, 48, 50), columns // 30)
    return drawing


def _door(rng: Generator, shape: tuple[int, int]) -> ImageArray:
    """A wooden door with panels, a frame and a knob."""
    rows, columns = shape
    brown = np.array([0.42, 0.66, 1.0]) * rng.uniform(90, 190)
    color: Color = tuple(brown.tolist())
    image = wood(rng, (columns, rows), color, 2.0 / rows).transpose(1, 0, 2).copy()
    line = max(2, columns // 90)
    split = rng.uniform(0.35, 0.6)
    for low, high in ((0.07, split - 0.03), (split + 0.03, 0.92)):
        a, b = (int(0.16 * columns), int(low * rows)), (int(0.84 * columns), int(high * rows))
        cv2.rectangle(image, a, b, tuple(0.6 * c for c in color), 2 * line)
        cv2.line(image, (a[0], b[1]), b, tuple(1.3 * c for c in color), line)
    knob = (int((0.09 if rng.random() < 0.5 else 0.91) * columns), int(0.52 * rows))
    cv2.circle(image, knob, columns // 28, (190, 205, 210), -1, cv2.LINE_AA)
    cv2.rectangle(image, (0, 0), (columns - 1, rows), (35, 45, 60), 5 * line)
    return np.asarray(image)


def _tag(number: int, shape: tuple[int, int]) -> ImageArray:
    """Draw an AprilTag of the family 36h11, of 8 modules in a white border of one."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    modules = cv2.aruco.generateImageMarker(dictionary, number, 8)
    white = np.pad(modules, 1, constant_values=255)
    tag = cv2.resize(white, shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.cvtColor(tag, cv2.COLOR_GRAY2BGR), dtype=np.uint8)


_PAINTERS: dict[str, Callable[[Generator, tuple[int, int]], ImageArray]] = {
    'photo': draw_photo,
    'poster': _poster,
    'shelf': _books,
    'books': _books,
    'target': _target,
    'blinds': _blinds,
    'door': _door,
    'sheet': _sheet,
}
