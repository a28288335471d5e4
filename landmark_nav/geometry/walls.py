"""The wall map: vertical rectangles, ray casting, anchor papers and their colours."""

from __future__ import annotations

from collections.abc import Sequence
import colorsys
from dataclasses import dataclass
from functools import cached_property
import re

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray, IndexArray
from landmark_nav.errors import LandmarkNavError, shown
from landmark_nav.geometry.se2 import cross

# Tolerance when a wall is tested for hiding a point: thickness of what hangs on a wall, and number
# of standard deviations of the wall's position.
_THICKNESS_M, _SLACK_SIGMAS = 0.08, 3.0


@dataclass(frozen=True)
class Wall:
    """
    A wall from `start` to `end` (x, y in map, metres); the room lies to its left.

    `sigma_m` is the standard deviation of its position; None for accurately measured walls.
    """

    id: str
    start: tuple[float, float]
    end: tuple[float, float]
    height: float
    sigma_m: float | None = None

    @property
    def length(self) -> float:
        """Length, metres."""
        return float(np.hypot(self.end[0] - self.start[0], self.end[1] - self.start[1]))

    @property
    def along(self) -> FloatArray:
        """Unit vector from start to end, (2,)."""
        return np.asarray(np.subtract(self.end, self.start) / self.length)

    @property
    def normal(self) -> FloatArray:
        """Unit normal into the room, (3,)."""
        dx, dy = (self.end[0] - self.start[0], self.end[1] - self.start[1])
        return np.array([-dy, dx, 0.0]) / self.length


@dataclass(frozen=True)
class Paper:
    """An anchor paper of the reference area: centre (x, y, z in map) and size, metres."""

    color: str
    center: tuple[float, float, float]
    width: float
    height: float

    @property
    def name(self) -> str:
        """Name for people."""
        return f'{self.color} paper'

    @property
    def bgr(self) -> tuple[float, float, float]:
        """Blue, green and red, 0 to 255."""
        return paper_bgr(self.color)


# Dictionaries of markers as OpenCV names them, and the number of their markers.
_DICTIONARIES = {
    f'DICT_{n}X{n}_{count}': count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)
} | {
    'DICT_ARUCO_ORIGINAL': 1024,
    'DICT_APRILTAG_16h5': 30,
    'DICT_APRILTAG_25h9': 35,
    'DICT_APRILTAG_36h10': 2320,
    'DICT_APRILTAG_36h11': 587,
}


def marker_count(name: str) -> int:
    """Return the size of a dictionary; `LandmarkNavError` if OpenCV has none of this name."""
    if name not in _DICTIONARIES:
        raise LandmarkNavError(
            f'marker dictionary {shown(name)}: take one that OpenCV has, as DICT_4X4_50, '
            'DICT_6X6_250 or DICT_APRILTAG_36h11'
        )
    return _DICTIONARIES[name]


@dataclass(frozen=True)
class Marker:
    """An ArUco or AprilTag marker: centre (x, y, z in map), side of its black square, m."""

    number: int
    center: tuple[float, float, float]
    size: float

    @property
    def name(self) -> str:
        """Name for people."""
        return f'marker {self.number}'

    @property
    def width(self) -> float:
        """Width, metres."""
        return self.size

    height = width
    bgr = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Room:
    """
    Walls, and anchor papers and markers of one dictionary, in the map frame.

    Raises `LandmarkNavError`: fewer than 3 walls, a wall without length or height, two walls of
    one name, an open outline, walls that cross or run clockwise.
    """

    walls: tuple[Wall, ...]
    papers: tuple[Paper, ...] = ()
    frame_id: str = 'map'
    markers: tuple[Marker, ...] = ()
    marker_dictionary: str = 'DICT_4X4_50'

    def __post_init__(self) -> None:
        """Check that the outline is closed and does not cross itself."""
        if len(self.walls) < 3:
            raise LandmarkNavError(f'room has {len(self.walls)} walls: a closed outline needs 3')
        for wall in self.walls:
            if not np.all(np.isfinite([*wall.start, *wall.end, wall.height])):
                raise LandmarkNavError(f'wall {wall.id} has a coordinate that is not a number')
            if wall.length < 1e-3 or wall.height <= 0.0:
                raise LandmarkNavError(f'wall {wall.id} has no length or no height')
        names = [wall.id for wall in self.walls]
        for name in names:
            if names.count(name) > 1:
                raise LandmarkNavError(f'two walls are called {name}: give each a name of its own')
        self._check_closed()
        self._check_crossings()

    def _check_closed(self) -> None:
        starts = self._starts
        for wall in self.walls:
            gap = np.hypot(*(starts - np.asarray(wall.end)).T)
            if np.sum(gap < 1e-2) != 1:
                raise LandmarkNavError(
                    f'the walls are open: wall {wall.id} ends at '
                    f'({wall.end[0]:g}, {wall.end[1]:g}) where {np.sum(gap < 1e-2)} walls start '
                    f'(nearest start is {gap.min():.3g} m away); one must start there'
                )

    def _check_crossings(self) -> None:
        a, b = self._starts, self._ends
        side = b - a
        # Segments i and j cross if the ends of each lie on different sides of the other.
        start_side = cross(side[:, None], a[None] - a[:, None])
        end_side = cross(side[:, None], b[None] - a[:, None])
        splits = start_side * end_side < -1e-9
        for i, j in zip(*np.nonzero(splits & splits.T), strict=True):
            raise LandmarkNavError(
                f'walls {self.walls[i].id} and {self.walls[j].id} cross: fix room.yaml'
            )
        area = 0.5 * float(np.sum(cross(a, b)))
        if area <= 0.0:
            raise LandmarkNavError(
                'the inside of the room must lie to the left of start -> end: '
                'the walls run clockwise, swap start and end of each'
            )

    @property
    def anchors(self) -> tuple[Paper | Marker, ...]:
        """What gives the pose of a sweep: the papers, or markers where there are none."""
        return self.papers or self.markers

    @cached_property
    def _starts(self) -> FloatArray:
        return np.array([w.start for w in self.walls], dtype=np.float64)

    @cached_property
    def _ends(self) -> FloatArray:
        return np.array([w.end for w in self.walls], dtype=np.float64)

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Least and largest x and y of the outline, each (2,)."""
        return self._starts.min(axis=0), self._starts.max(axis=0)

    @cached_property
    def slack_m(self) -> FloatArray:
        """Tolerance of each wall when it is tested for hiding a point, (walls,)."""
        sigma = np.array([wall.sigma_m or 0.0 for wall in self.walls])
        return _THICKNESS_M + _SLACK_SIGMAS * sigma

    @cached_property
    def normals(self) -> FloatArray:
        """Unit normals into the room, (walls, 3)."""
        return np.array([w.normal for w in self.walls])

    def raycast(
        self, origin_xy: npt.ArrayLike, azimuth_rad: npt.ArrayLike
    ) -> tuple[FloatArray, IndexArray]:
        """
        Horizontal distance to the first wall along rays.

        Parameters
        ----------
        origin_xy : array_like, shape (..., 2)
            Origins of the rays, map frame, metres.
        azimuth_rad : array_like, shape (...)
            Directions of the rays in map.

        Returns
        -------
        distance : ndarray, shape (...)
            Metres; inf where no wall is hit.
        wall : ndarray of int, shape (...)
            Index of the wall, -1 where none is hit.
        """
        azimuth = np.asarray(azimuth_rad, dtype=np.float64)
        distance = self._wall_hits(origin_xy, np.cos(azimuth), np.sin(azimuth))
        wall = np.argmin(distance, axis=-1)
        nearest = np.take_along_axis(distance, wall[..., None], -1)[..., 0]
        return nearest, np.where(np.isfinite(nearest), wall, -1)

    def _wall_hits(
        self, origin_xy: npt.ArrayLike, along_x: FloatArray, along_y: FloatArray
    ) -> FloatArray:
        """Distance (..., walls) to each wall in units of the ray vector's length; inf: no hit."""
        x, y = np.asarray(along_x)[..., None], np.asarray(along_y)[..., None]
        side_x, side_y = (self._ends - self._starts).T
        offset = self._starts - np.asarray(origin_xy, dtype=np.float64)[..., None, :]
        offset_x, offset_y = offset[..., 0], offset[..., 1]
        with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
            denominator = x * side_y - y * side_x
            along_ray = (offset_x * side_y - offset_y * side_x) / denominator
            along_wall = (offset_x * y - offset_y * x) / denominator
        hit = (along_ray > 1e-9) & (along_wall >= -1e-9) & (along_wall <= 1.0 + 1e-9)
        return np.where(hit, along_ray, np.inf)

    def shares_wall(self, walls: Sequence[Wall], within_m: float) -> bool:
        """Whether start and end of one of `walls` are `within_m` of those of a wall here."""
        ends = np.array([(*wall.start, *wall.end) for wall in walls]).reshape(-1, 1, 2, 2)
        gaps = np.linalg.norm(ends - np.stack([self._starts, self._ends], 1), axis=-1)
        return bool(np.any(gaps.max(-1) < within_m))

    def visible(self, origin_xy: npt.ArrayLike, points_xy: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether no wall is between origins (..., 2) and points (..., 2)."""
        return np.asarray(~self.hiding(origin_xy, points_xy).any(axis=-1))

    def hiding(self, origin_xy: npt.ArrayLike, points_xy: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Which walls are between origins (..., 2) and points (..., 2), (..., walls)."""
        delta = np.asarray(points_xy, dtype=np.float64) - np.asarray(origin_xy, dtype=np.float64)
        x, y = delta[..., 0], delta[..., 1]
        reach = np.maximum(np.hypot(x, y), 1e-12)
        beyond = (self._wall_hits(origin_xy, x, y) - 1.0) * reach[..., None] + self.slack_m
        return np.asarray(beyond <= 0.0)

    def contains(self, points_xy: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether points (..., 2) lie inside the outline (even-odd rule)."""
        points = np.asarray(points_xy, dtype=np.float64)
        x, y = points[..., 0, None], points[..., 1, None]
        a, b = self._starts, self._ends
        with np.errstate(divide='ignore', invalid='ignore'):
            x_cross = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
        crosses = ((a[:, 1] > y) != (b[:, 1] > y)) & (x < x_cross)
        return np.asarray(np.sum(crosses, axis=-1) % 2 == 1)

    def nearest_wall(self, points_xy: npt.ArrayLike) -> IndexArray:
        """Index of the wall nearest to points (..., 2)."""
        return np.asarray(np.argmin(self.wall_distances(points_xy), -1))

    def wall_distances(self, points_xy: npt.ArrayLike) -> FloatArray:
        """Distances (..., walls) of points (..., 2) from the walls, metres."""
        return segment_distances(points_xy, self._starts, self._ends - self._starts)


def segment_distances(
    points_xy: npt.ArrayLike, starts: FloatArray, sides: FloatArray
) -> FloatArray:
    """Distances (..., n) of points (..., 2) from segments by their starts and vectors (n, 2)."""
    offset = np.asarray(points_xy, dtype=np.float64)[..., None, :] - starts
    share = np.clip(np.sum(offset * sides, -1) / np.sum(sides**2, -1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * sides, axis=-1))


NAMED_HUES_DEG = {
    'red': 0,
    'orange': 26,
    'yellow': 56,
    'lime': 85,
    'green': 125,
    'turquoise': 165,
    'cyan': 185,
    'blue': 230,
    'violet': 270,
    'magenta': 300,
    'pink': 335,
}

# Saturation and value of a colour given by name.
_NAMED_SATURATION, _NAMED_VALUE = 0.75, 0.75
# Smallest saturation; below it, coloured light changes the hue too much.
_MIN_SATURATION = 0.3
_HSV = re.compile(r'hsv\(\s*([\d.]+)\s*,\s*([\d.]+)%?\s*,\s*([\d.]+)%?\s*\)')
_HEX = re.compile(r'#([0-9a-fA-F]{2})([0-9a-fA-F]{2})([0-9a-fA-F]{2})')


def paper_bgr(color: str) -> tuple[float, float, float]:
    """
    Blue, green and red of a paper, 0 to 255.

    Raises `LandmarkNavError`: not a colour, or one without a hue.
    """
    text = color.strip().lower()
    named, hsv, hexadecimal = NAMED_HUES_DEG.get(text), _HSV.fullmatch(text), _HEX.fullmatch(text)
    if named is not None:
        rgb = colorsys.hsv_to_rgb(named / 360.0, _NAMED_SATURATION, _NAMED_VALUE)
    elif hsv:
        h, s, v = (float(part) for part in hsv.groups())
        rgb = colorsys.hsv_to_rgb(h % 360.0 / 360.0, min(s, 100.0) / 100.0, min(v, 100.0) / 100.0)
    elif hexadecimal:
        r, g, b = (int(part, 16) / 255.0 for part in hexadecimal.groups())
        rgb = (r, g, b)
    else:
        raise LandmarkNavError(
            f'paper colour {shown(color)} is not known: take one of {", ".join(NAMED_HUES_DEG)}, '
            "'#rrggbb' in quotes, or hsv(degrees, percent, percent)"
        )
    if max(rgb) - min(rgb) < _MIN_SATURATION * max(rgb) or max(rgb) < 0.1:
        raise LandmarkNavError(
            f'paper colour {shown(color)} is too grey or too dark to be recognised by its hue: '
            'hang a more vivid paper'
        )
    return 255.0 * rgb[2], 255.0 * rgb[1], 255.0 * rgb[0]
