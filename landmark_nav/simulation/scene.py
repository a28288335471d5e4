"""
Description of a simulated room with items, furniture and lamps; places for sweeps in it.

Scenes are immutable: the generator creates one by a seed, and changes are copies.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.se2 import transform_points
from landmark_nav.geometry.walls import Room, segment_distances
from landmark_nav.types import FloatArray


@dataclass(frozen=True)
class WallItem:
    """
    Something flat that hangs on a wall.

    Kinds are ``photo``, ``poster``, ``shelf``, ``blinds``, ``door``, ``target``, ``sheet`` (a
    coloured paper that is not in ``room.yaml``) and ``tag`` (an AprilTag, whose number is the
    `seed`). The centre is `along_m` from the start of the wall; `before_m` is the distance of the
    face from the wall: the depth of a frame.
    """

    kind: str
    wall: int
    along_m: float
    center_z_m: float
    width_m: float
    height_m: float
    seed: int
    before_m: float = 0.0

    def center(self, room: Room) -> FloatArray:
        """Centre in map, (3,)."""
        wall = room.walls[self.wall]
        start, end = np.asarray(wall.start), np.asarray(wall.end)
        xy = start + (end - start) * (self.along_m / wall.length)
        return np.array([*xy, self.center_z_m]) + self.before_m * wall.normal


@dataclass(frozen=True)
class Box:
    """
    A piece of furniture: an upright box on the floor.

    `center_xy` and `yaw_rad` are its pose in map; `size_m` is its length, depth and height;
    `material` is ``wood``, ``books``, ``paint`` or a colour.
    """

    center_xy: tuple[float, float]
    yaw_rad: float
    size_m: tuple[float, float, float]
    material: str
    seed: int

    @property
    def footprint(self) -> FloatArray:
        """Corners on the floor, counter-clockwise, (4, 2)."""
        half = 0.5 * np.array(self.size_m[:2])
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        return transform_points([*self.center_xy, self.yaw_rad], corners)


@dataclass(frozen=True)
class Lamp:
    """
    A luminous panel under the ceiling, or daylight at a window.

    `position` is (x, y, z) in map; `size_m` is the size of the panel, 0 for daylight, which is not
    drawn; `power` is relative to a usual lamp; `tint` is its colour, blue, green, red.
    """

    position: tuple[float, float, float]
    size_m: tuple[float, float]
    power: float = 1.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Scene:
    """A room with its contents; `seed` is that of the textures of walls, floor and ceiling."""

    seed: int
    room: Room
    items: tuple[WallItem, ...] = ()
    boxes: tuple[Box, ...] = ()
    lamps: tuple[Lamp, ...] = ()

    @property
    def target(self) -> WallItem | None:
        """The specialised target, if there is one."""
        return next((item for item in self.items if item.kind == 'target'), None)

    def sees(
        self, eye_xy: npt.ArrayLike, points_xy: npt.ArrayLike, eye_height_m: float
    ) -> npt.NDArray[np.bool_]:
        """
        Whether points on walls are not hidden by walls or by furniture higher than the eye.

        Viewpoints and points (..., 2) are broadcast.
        """
        seen = self.room.visible(eye_xy, points_xy)
        eye = np.asarray(eye_xy, dtype=np.float64)
        way = np.asarray(points_xy, dtype=np.float64) - eye
        for box in self.boxes:
            if box.size_m[2] < eye_height_m:
                continue
            # Sutherland's clipping: the line of sight is blocked if a part of it is inside.
            enter, leave = np.zeros(way.shape[:-1]), np.ones(way.shape[:-1])
            corners = box.footprint
            for corner, side in zip(corners, np.roll(corners, -1, axis=0) - corners, strict=True):
                normal = np.array([side[1], -side[0]])
                outside, slope = (eye - corner) @ normal, way @ normal
                with np.errstate(divide='ignore', invalid='ignore'):
                    at = -outside / slope
                enter = np.where(slope < 0.0, np.maximum(enter, at), enter)
                leave = np.where(slope > 0.0, np.minimum(leave, at), leave)
                leave = np.where((slope == 0.0) & (outside > 0.0), -1.0, leave)
            seen &= enter >= leave - 1e-9
        return np.asarray(seen)

    def distance_to_obstacles(self, points_xy: npt.ArrayLike) -> FloatArray:
        """
        Distance of points (..., 2) from walls and furniture, metres, (...).

        It is 0 inside furniture, and has no meaning outside the room.
        """
        points = np.asarray(points_xy, dtype=np.float64)
        distance = segment_distances(points, *self._edges).min(-1)
        if self.boxes:
            corner, inward = self._box_sides
            depth = np.sum((points[..., None, None, :] - corner) * inward, -1).min(-1)
            distance = np.where((depth > 0.0).any(-1), 0.0, distance)
        return np.asarray(distance)

    @cached_property
    def _edges(self) -> tuple[FloatArray, FloatArray]:
        """Starts and vectors (n, 2) of all walls and sides of furniture."""
        outlines = [np.array([wall.start, wall.end]) for wall in self.room.walls]
        outlines += [np.vstack([box.footprint, box.footprint[:1]]) for box in self.boxes]
        start = np.concatenate([line[:-1] for line in outlines])
        return start, np.concatenate([np.diff(line, axis=0) for line in outlines])

    @cached_property
    def _box_sides(self) -> tuple[FloatArray, FloatArray]:
        """Corners and inward normals (boxes, 4, 2) of the furniture."""
        corner = np.array([box.footprint for box in self.boxes])
        edge = np.roll(corner, -1, axis=1) - corner
        return corner, np.stack([-edge[..., 1], edge[..., 0]], -1)


# Height of the camera; furniture below it hides nothing on walls.
EYE_HEIGHT_M = 1.1
# Largest tangent of elevation in the image of a usual camera, with some reserve.
_STEEPEST_VIEW = 0.4
# Largest angles of incidence of papers, other items and the target.
_STEEPEST_PAPER_DEG = 68.0
_STEEPEST_ITEM_DEG = 62.0
_STEEPEST_TARGET_DEG = 55.0
_CLEARANCE_M = 0.5
_BASELINE_M = (1.5, 2.5)
_CANDIDATES = 140


@dataclass(frozen=True, eq=False)
class SweepPlaces:
    """Poses (2, 3) of the base in map, and the number of items in good view from both."""

    poses: FloatArray
    shared_items: int


def choose_sweep_places(scene: Scene) -> SweepPlaces | None:
    """
    Choose the two poses for sweeps with the most common view, 1.5 to 2.5 m apart.

    The seed of the scene determines the positions that are tried, and the headings. None if no
    pair has all papers and the target in view.
    """
    rng = np.random.default_rng([scene.seed, 10])
    places = rng.uniform(*scene.room.bounds, (_CANDIDATES * 4, 2))
    places = places[scene.room.contains(places)]
    places = places[scene.distance_to_obstacles(places) > _CLEARANCE_M][:_CANDIDATES]
    if len(places) < 2:
        return None
    papers = np.array([p.center for p in scene.room.papers]).reshape(-1, 3)
    papers[:, 2] += [0.5 * p.height for p in scene.room.papers]
    paper_walls = scene.room.nearest_wall(papers[:, :2]) if len(papers) else np.zeros(0, np.intp)
    good = view_quality(scene, places, papers, paper_walls, _STEEPEST_PAPER_DEG) > 0.0
    places = places[good.all(axis=1)]
    items, walls = item_points(scene)
    quality = view_quality(scene, places, items, walls, _STEEPEST_ITEM_DEG)
    if scene.target is not None:
        at = [scene.items.index(scene.target)]
        target = view_quality(scene, places, items[at], walls[at], _STEEPEST_TARGET_DEG)
        places, quality = places[target[:, 0] > 0.0], quality[target[:, 0] > 0.0]
    if len(places) < 2:
        return None
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    both = np.minimum(quality[:, None], quality[None])
    offset = items[None, :, :2] - places[:, None]
    azimuth = np.arctan2(offset[..., 1], offset[..., 0])
    parallax = np.abs(np.angle(np.exp(1j * (azimuth[:, None] - azimuth[None]))))
    shared = (both > 0.0) & (parallax > np.radians(12.0))
    wide = np.minimum(parallax / np.radians(45.0), 1.0)
    score = np.where(shared, 0.5 + both + wide, 0.0).sum(-1)
    score[(apart < _BASELINE_M[0]) | (apart > _BASELINE_M[1])] = -1.0
    i, j = np.unravel_index(int(np.argmax(score)), score.shape)
    if score[i, j] < 0.0:
        return None
    headings = rng.uniform(-np.pi, np.pi, 2)
    poses = np.column_stack([places[[i, j]], headings])
    return SweepPlaces(poses, int(shared[i, j].sum()))


def sweep_places(scene: Scene) -> SweepPlaces:
    """Return the places of sweeps of a scene by `generate_scene`, which has some."""
    places = choose_sweep_places(scene)
    assert places is not None, 'such scenes have places'
    return places


def item_points(scene: Scene) -> tuple[FloatArray, npt.NDArray[np.intp]]:
    """Centres (n, 3) of the items on walls, and indices of their walls (n,)."""
    points = np.array([item.center(scene.room) for item in scene.items]).reshape(-1, 3)
    return points, np.array([item.wall for item in scene.items], dtype=np.intp)


def seen_from_all(scene: Scene, places_xy: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Whether an item is in good view from all positions (n, 2), for each item of `scene`."""
    points, walls = item_points(scene)
    quality = view_quality(scene, places_xy, points, walls, _STEEPEST_ITEM_DEG)
    return np.asarray((quality > 0.0).all(axis=0))


def view_quality(
    scene: Scene,
    places_xy: npt.ArrayLike,
    points: npt.ArrayLike,
    walls: npt.ArrayLike,
    steepest_deg: float,
) -> FloatArray:
    """
    Quality (n, m) of the view of points (m, 3) on walls from places (n, 2).

    It is the cosine of the angle of incidence; 0 if the point is hidden, too far, too near, too
    oblique, or above or below the image.
    """
    places = np.asarray(places_xy, dtype=np.float64).reshape(-1, 1, 2)
    ends = np.asarray(points, dtype=np.float64).reshape(1, -1, 3)
    normals = scene.room.normals[np.asarray(walls, dtype=np.intp), :2]
    way = places - ends[..., :2]
    distance = np.linalg.norm(way, axis=-1)
    facing = np.sum(way * normals, -1) / np.maximum(distance, 1e-9)
    good = (distance > 1.0) & (distance < 5.5) & (facing > np.cos(np.radians(steepest_deg)))
    good &= np.abs(ends[..., 2] - EYE_HEIGHT_M) < _STEEPEST_VIEW * distance
    eyes, seen = np.broadcast_arrays(places, ends[..., :2])
    good &= scene.sees(eyes, seen, EYE_HEIGHT_M)
    return np.where(good, facing, 0.0)
