"""Surfaces of a scene, grouped into solids: walls and furniture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Paper, paper_bgr, Room
from landmark_nav.simulation.scene import Box, Lamp, Scene, WallItem
from landmark_nav.simulation.surfaces import Surface
from landmark_nav.simulation.textures import Color, draw_item, plaster, random_color, wood
from landmark_nav.types import FloatArray, ImageArray

_WALL_TEXEL_M = 0.002
_BOX_TEXEL_M = 0.0025
_FLOOR_TEXEL_M = 0.004
_CEILING_TEXEL_M = 0.008
# Levels of foreshortening in the pyramids of walls: up to a factor of eight.
_WALL_SLANTS = 4
# Colours of printed papers, blue, green, red; papers of other colours have exactly that colour.
_PAPER_COLORS = {
    'red': (38.0, 36.0, 196.0),
    'green': (58.0, 150.0, 34.0),
    'blue': (165.0, 62.0, 36.0),
}

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Solid:
    """Surfaces that are painted together in this order, and their common footprint."""

    footprint: FloatArray
    surfaces: tuple[Surface, ...]


def wall_solids(scene: Scene) -> list[Solid]:
    """One solid for each wall, with its items and papers."""
    return list(_drawn_walls(scene.seed, scene.room, scene.items))


# Cached: drawing takes seconds, and scenes with other lamps or furniture have the same walls.
@lru_cache(maxsize=1)
def _drawn_walls(seed: int, room: Room, items: tuple[WallItem, ...]) -> tuple[Solid, ...]:
    rng = np.random.default_rng([seed, 1])
    color = np.array([172.0, 186.0, 192.0]) * rng.uniform(0.88, 1.06) + rng.uniform(-10, 10, 3)
    height = max(wall.height for wall in room.walls)
    solids = []
    for index, wall in enumerate(room.walls):
        start, end = np.array(wall.start), np.array(wall.end)
        across = np.append((start - end) / wall.length, 0.0)
        shape = (round(height / _WALL_TEXEL_M), round(wall.length / _WALL_TEXEL_M))
        rng = np.random.default_rng([seed, 2, index])
        texture = plaster(rng, shape, tuple(color.tolist()), 0.002)
        hung = [item for item in items if item.wall == index]
        for item in hung:
            if item.before_m == 0.0:
                left = wall.length - item.along_m - item.width_m / 2
                top = height - item.center_z_m - item.height_m / 2
                _hang(texture, item, (left / wall.length, top / height), wall.length, height)
        corner = np.array([*end, height])
        size = wall.length, height
        surfaces = [Surface(corner, across, -_UP, *size, texture, slants=_WALL_SLANTS)]
        surfaces += [_item_surface(item, room, across) for item in hung if item.before_m > 0.0]
        surfaces += [
            _paper_surface(paper, across)
            for paper in room.papers
            if room.nearest_wall(paper.center[:2]) == index
        ]
        solids.append(Solid(np.array([start, end]), tuple(surfaces)))
    return tuple(solids)


def _hang(
    texture: ImageArray, item: WallItem, corner: tuple[float, float], length: float, height: float
) -> None:
    """Draw `item` into the texture of a wall; `corner` (x, y) is relative to the wall's size."""
    # The content is exact to a part of a texel; only the outline is rounded to texels.
    texels = np.array(texture.shape[1::-1], dtype=np.float64)
    low = np.array(corner) * texels
    size = np.array([item.width_m / length, item.height_m / height]) * texels
    drawing = draw_item(item.kind, item.seed, (round(size[1]), round(size[0])))
    a = np.clip(np.rint(low), 0, texels).astype(int)
    b = np.clip(np.rint(low + size), 0, texels).astype(int)
    scale = size / drawing.shape[1::-1]
    shift = low - a + 0.5 * scale - 0.5
    warp = np.array([[scale[0], 0.0, shift[0]], [0.0, scale[1], shift[1]]])
    texture[a[1] : b[1], a[0] : b[0]] = cv2.warpAffine(
        drawing, warp, (int(b[0] - a[0]), int(b[1] - a[1])), borderMode=cv2.BORDER_REPLICATE
    )


def _item_surface(item: WallItem, room: Room, across: FloatArray) -> Surface:
    size = item.width_m, item.height_m
    corner = item.center(room) - across * size[0] / 2 + _UP * size[1] / 2
    columns, rows = (round(length / _WALL_TEXEL_M) for length in size)
    drawing = draw_item(item.kind, item.seed, (rows, columns))
    return Surface(corner, across, -_UP, *size, drawing, slants=_WALL_SLANTS)


def _paper_surface(paper: Paper, across: FloatArray) -> Surface:
    corner = np.array(paper.center) - across * paper.width / 2 + _UP * paper.height / 2
    color = np.array(_PAPER_COLORS.get(paper.color) or paper_bgr(paper.color))
    texture = np.tile(np.rint(color).astype(np.uint8), (64, 48, 1))
    return Surface(corner, across, -_UP, paper.width, paper.height, texture)


def box_solid(box: Box) -> Solid:
    """Sides and top of a piece of furniture."""
    rng = np.random.default_rng([box.seed, 3])
    base = np.array([45.0, 75.0, 108.0]) * rng.uniform(0.8, 1.3)
    color: Color = tuple(base.tolist())
    if box.material == 'paint':
        color = random_color(rng, (0.1, 0.5), (0.4, 0.8))
    elif box.material not in ('wood', 'books'):
        color = paper_bgr(box.material)
    corners, height = box.footprint, box.size_m[2]
    surfaces = []
    for k in range(4):
        # Seen from outside, sides of a counter-clockwise outline run to the right.
        side = corners[(k + 1) % 4] - corners[k]
        width = float(np.linalg.norm(side))
        texture = _box_texture(box, color, k, (width, height))
        corner = np.array([*corners[k], height])
        across = np.append(side / width, 0.0)
        surfaces.append(Surface(corner, across, -_UP, width, height, texture, slants=3))
    long, deep = corners[1] - corners[0], corners[0] - corners[3]
    size = (float(np.linalg.norm(long)), float(np.linalg.norm(deep)))
    texture = _box_texture(box, color, 4, size)
    corner = np.array([*corners[3], height])
    across, down = np.append(long / size[0], 0.0), np.append(deep / size[1], 0.0)
    surfaces.append(Surface(corner, across, down, *size, texture))
    return Solid(corners, tuple(surfaces))


def _box_texture(box: Box, tone: Color, side: int, size: tuple[float, float]) -> ImageArray:
    shape = (max(8, round(size[1] / _BOX_TEXEL_M)), max(8, round(size[0] / _BOX_TEXEL_M)))
    rng = np.random.default_rng([box.seed, 4, side])
    if box.material == 'books' and side < 4:
        return draw_item('books', int(rng.integers(2**31)), shape)
    if box.material not in ('wood', 'books'):
        texture = plaster(rng, shape, tone, _BOX_TEXEL_M)
    else:
        texture = wood(rng, shape, tone, _BOX_TEXEL_M)
    dark = tuple(0.55 * c for c in tone)
    cv2.rectangle(texture, (0, 0), (shape[1] - 1, shape[0] - 1), dark, 4)
    return texture


def background_surfaces(scene: Scene) -> list[Surface]:
    """Floor and ceiling: the bounding box of the room with a margin, behind all walls."""
    low, high = scene.room.bounds[0] - 0.5, scene.room.bounds[1] + 0.5
    width, depth = (float(size) for size in high - low)
    height = max(wall.height for wall in scene.room.walls)
    rng = np.random.default_rng([scene.seed, 5])
    base = np.array([58.0, 88.0, 122.0]) * rng.uniform(0.7, 1.25)
    shape = (round(depth / _FLOOR_TEXEL_M), round(width / _FLOOR_TEXEL_M))
    floor = wood(rng, shape, tuple(base.tolist()), _FLOOR_TEXEL_M, 0.13)
    east, north = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    shape = (round(depth / _CEILING_TEXEL_M), round(width / _CEILING_TEXEL_M))
    ceiling = plaster(rng, shape, (168.0, 172.0, 174.0), _CEILING_TEXEL_M)
    for lamp in scene.lamps:
        _paint_panel(ceiling, lamp, low)
    return [
        Surface(np.array([low[0], high[1], 0.0]), east, -north, width, depth, floor),
        Surface(np.array([*low, height]), east, north, width, depth, ceiling, lit=False),
    ]


def _paint_panel(ceiling: ImageArray, lamp: Lamp, low: FloatArray) -> None:
    """Draw the panel of a lamp into the texture of the ceiling."""
    if min(lamp.size_m) <= 0.0:
        return
    half = 0.5 * np.array(lamp.size_m)
    center = np.array(lamp.position[:2]) - low
    a, b = (np.rint((center + s * half) / _CEILING_TEXEL_M).astype(int) for s in (-1, 1))
    glow = 120.0 + 135.0 * min(lamp.power, 1.0)
    cv2.rectangle(ceiling, a.tolist(), b.tolist(), (glow, glow, glow), -1)


# Azimuths farther from that of the view are ignored.
_WIDEST_VIEW_RAD = np.radians(80.0)


def back_to_front(
    footprints: Sequence[FloatArray], viewer_xy: FloatArray, heading_rad: float
) -> list[int]:
    """
    Order upright prisms by which can hide which, the farthest first; return their indices.

    Two convex footprints that do not overlap are separated by a line along a side of one of them.
    The one on the viewer's side can hide the other, but is never hidden by it. This gives the
    order of two footprints at common azimuths; for convex footprints within half a turn the order
    has no cycles. Newell, Newell and Sancha, A solution to the hidden surface problem, ACM 1972,
    is the general case.

    Footprints are outlines (4, 2), counter-clockwise, or walls (2, 2); `heading_rad` is the
    azimuth of the view.
    """
    # The two ends of a wall are repeated.
    corners = np.array([np.resize(shape, (4, 2)) for shape in footprints]).reshape(-1, 4, 2)
    side = np.roll(corners, -1, axis=1) - corners
    outward = np.stack([side[..., 1], -side[..., 0]], -1)
    outward /= np.linalg.norm(side, axis=-1, keepdims=True)
    # Of the lines along the sides (i, side), the one with the widest gap to each other footprint.
    reach = np.einsum('isc,jkc->isjk', outward, corners).min(-1)
    gaps = reach - np.sum(corners * outward, -1)[..., None]
    beyond = np.sum((viewer_xy - corners) * outward, -1)
    gap, beyond = gaps.max(1), np.take_along_axis(beyond, gaps.argmax(1), 1)
    # How far the viewer is on the side of j of the line between i and j.
    side_of = np.triu(np.where(gap >= gap.T, beyond, -beyond.T), 1)
    right, left = _extent(corners - viewer_xy, heading_rad)
    overlap = np.minimum(left[:, None], left) - np.maximum(right[:, None], right) > 1e-9
    # Row i, column j: j is on the viewer's side, so i is painted before j.
    before = (side_of - side_of.T > 1e-9) & overlap
    blocked_by = before.sum(axis=0)
    remaining = list(range(len(corners)))
    order: list[int] = []
    while remaining:
        first = min(remaining, key=lambda k: blocked_by[k])
        remaining.remove(first)
        blocked_by = blocked_by - before[first]
        order.append(first)
    return order


def _extent(offsets: FloatArray, heading_rad: float) -> tuple[FloatArray, FloatArray]:
    """Azimuths (n,) of the right and left end of outlines (n, 4, 2) relative to the heading."""
    middle = offsets.mean(axis=1)
    center = wrap_rad(np.arctan2(middle[:, 1], middle[:, 0]) - heading_rad)[:, None]
    azimuth = np.arctan2(offsets[..., 1], offsets[..., 0]) - heading_rad
    # Narrower than half a turn, since the viewer is outside: unwrapped around the centre.
    azimuth = center + wrap_rad(azimuth - center)
    ends = np.clip([azimuth.min(axis=1), azimuth.max(axis=1)], -_WIDEST_VIEW_RAD, _WIDEST_VIEW_RAD)
    return ends[0], ends[1]
