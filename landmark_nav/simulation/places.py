"""Sweep positions with a good view of papers and target, and visibility."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.simulation.scene import Scene
from landmark_nav.types import FloatArray

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
