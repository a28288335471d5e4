"""Procedural textures of items on walls, drawn at twice the size and averaged; BGR, uint8."""

from __future__ import annotations

from collections.abc import Callable
import itertools

import cv2
import numpy as np

from landmark_nav.geometry.walls import NAMED_HUES_DEG, paper_bgr
from landmark_nav.simulation import textures
from landmark_nav.types import ImageArray

Generator = np.random.Generator


def draw_item(kind: str, seed: int, shape: tuple[int, int]) -> ImageArray:
    """Draw a kind of `WallItem`, or ``books`` for the side of a bookcase, (rows, columns, 3)."""
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
    image[:] = textures.random_color(rng, (0.02, 0.15), (0.85, 1.0))
    title = int(rng.uniform(0.08, 0.16) * rows)
    image[:title] = textures.random_color(rng, (0.3, 0.9), (0.2, 0.6))
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
    color: textures.Color,
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
    cv2.rectangle(image, a, b, textures.random_color(rng, (0.3, 0.7), (0.4, 0.9)), -1)
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
            tone = textures.random_color(rng, (0.2, 0.9), (0.2, 1.0))
            cv2.rectangle(image, (round(x[0]), round(y[0])), (round(x[1]), round(y[1])), tone, -1)


def _books(rng: Generator, shape: tuple[int, int]) -> ImageArray:
    """Shelves full of books."""
    rows, columns = shape
    image = np.full((rows, columns, 3), (22, 24, 30), np.uint8)
    frame = max(3, int(0.03 * columns))
    shelves = max(2, round(rows / columns * rng.uniform(2.5, 3.5)))
    board = textures.random_color(rng, (0.3, 0.6), (0.3, 0.5))
    edges = np.linspace(0, rows, shelves + 1).astype(int)
    for low, high in itertools.pairwise(edges):
        x = float(frame)
        while x < columns - 2 * frame:
            width = columns * rng.uniform(0.018, 0.055)
            if rng.random() > 0.06:
                top = low + frame + (high - low) * rng.uniform(0.04, 0.3)
                spine = textures.random_color(rng, (0.1, 0.85), (0.15, 0.85))
                end = min(x + width - 2, columns - frame)
                cv2.rectangle(image, (round(x), round(top)), (round(end), high), spine, -1)
                label = top + (high - top) * rng.uniform(0.1, 0.4)
                tone = textures.random_color(rng, (0.0, 0.4), (0.6, 1.0))
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
    image *= 1.0 + 0.02 * textures.fractal_noise(rng, shape, (rows / 2, columns / 4), 3)[..., None]
    drawing = textures.to_uint8(image)
    for x in rng.uniform(0.1, 0.9, int(rng.integers(2, 4))) * columns:
        cv2.line(drawing, (round(x), 0), (round(x), rows), (70, 70, 70), 4)
    cv2.rectangle(drawing, (0, 0), (columns - 1, rows - 1), (48, 48, 50), columns // 30)
    return drawing


def _door(rng: Generator, shape: tuple[int, int]) -> ImageArray:
    """A wooden door with panels, a frame and a knob."""
    rows, columns = shape
    brown = np.array([0.42, 0.66, 1.0]) * rng.uniform(90, 190)
    color: textures.Color = tuple(brown.tolist())
    image = textures.wood(rng, (columns, rows), color, 2.0 / rows).transpose(1, 0, 2).copy()
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
    'photo': textures.draw_photo,
    'poster': _poster,
    'shelf': _books,
    'books': _books,
    'target': _target,
    'blinds': _blinds,
    'door': _door,
    'sheet': _sheet,
}
