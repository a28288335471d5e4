"""Sweep positions with a good view of papers and target, visibility, and painter's order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
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
    Choose two poses for sweeps.

    Parameters
    ----------
    scene : Scene
        Furnished room; its seed determines the positions that are tried, and the headings.

    Returns
    -------
    SweepPlaces or None
        The pair with the most common view, 1.5 to 2.5 m apart; None if no pair has all papers and
        the target in view.
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
    Quality of the view of points on walls.

    Parameters
    ----------
    places_xy : array_like, shape (n, 2)
        Viewpoints, map frame.
    points : array_like, shape (m, 3)
        Points on walls, map frame.
    walls : array_like of int, shape (m,)
        Indices of the walls.
    steepest_deg : float
        Largest angle of incidence.

    Returns
    -------
    ndarray, shape (n, m)
        Cosine of the angle of incidence; 0 if the point is hidden, too far, too near, too oblique,
        or above or below the image.
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


_WIDEST_VIEW_RAD = np.radians(80.0)

# Footprints are padded to four corners: the two ends of a wall are repeated.
_FOUR = np.arange(4)


class PainterOrder:
    """
    Back-to-front order of upright prisms, by lines that separate their footprints.

    Two convex footprints that do not overlap are separated by a line along a side of one of them.
    The one on the viewer's side can hide the other, but is never hidden by it. This gives the
    order of two footprints at common azimuths; for convex footprints within half a turn the order
    has no cycles. Newell, Newell and Sancha, A solution to the hidden surface problem, ACM 1972,
    is the general case.

    Parameters
    ----------
    footprints : sequence of ndarray, shape (k, 2)
        Convex outlines, counter-clockwise; two points are a wall.
    """

    def __init__(self, footprints: Sequence[FloatArray]) -> None:
        """Compute the separating lines."""
        self._footprints: list[FloatArray] = []
        self._normal = np.zeros((0, 0, 2))
        self._offset = np.zeros((0, 0))
        self._extend(footprints)

    def extended(self, footprints: Sequence[FloatArray]) -> PainterOrder:
        """Return an order with additional `footprints` at the end."""
        larger = PainterOrder([])
        larger._footprints = list(self._footprints)
        larger._normal, larger._offset = self._normal, self._offset
        larger._extend(footprints)
        return larger

    def back_to_front(
        self, viewer_xy: FloatArray, heading_rad: float, visible: Sequence[int]
    ) -> list[int]:
        """
        Sort footprints by their order for a viewer.

        Parameters
        ----------
        viewer_xy : ndarray, shape (2,)
            Viewpoint.
        heading_rad : float
            Azimuth of the view; azimuths more than 80 degrees from it are ignored.

        Returns
        -------
        list of int
            `visible`, farthest first.
        """
        index = np.asarray(visible, dtype=np.intp)
        pairs = np.ix_(index, index)
        side = self._normal[pairs] @ viewer_xy - self._offset[pairs]
        right, left = self._extent(index, viewer_xy, heading_rad)
        overlap = np.minimum(left[:, None], left) - np.maximum(right[:, None], right) > 1e-9
        # Row i, column j: j is on the viewer's side, so i is painted before j.
        before = (side > 1e-9) & overlap
        blocked_by = before.sum(axis=0)
        remaining = list(range(len(index)))
        order: list[int] = []
        while remaining:
            first = min(remaining, key=lambda k: blocked_by[k])
            remaining.remove(first)
            blocked_by = blocked_by - before[first]
            order.append(int(index[first]))
        return order

    def _extent(
        self, index: npt.NDArray[np.intp], viewer_xy: FloatArray, heading_rad: float
    ) -> tuple[FloatArray, FloatArray]:
        """Azimuths (n,) of the right and left end of footprints relative to the heading."""
        points = self._corners[index] - viewer_xy
        middle = points.mean(axis=1)
        center = wrap_rad(np.arctan2(middle[:, 1], middle[:, 0]) - heading_rad)
        azimuth = np.arctan2(points[..., 1], points[..., 0]) - heading_rad
        # Narrower than half a turn, since the viewer is outside: unwrapped around the centre.
        azimuth = center[:, None] + wrap_rad(azimuth - center[:, None])
        limit = _WIDEST_VIEW_RAD
        ends = np.clip([azimuth.min(axis=1), azimuth.max(axis=1)], -limit, limit)
        return ends[0], ends[1]

    def _extend(self, footprints: Sequence[FloatArray]) -> None:
        """Append footprints and lines; line (i, j) has i on its negative side, j beyond it."""
        known = len(self._footprints)
        self._footprints += [np.asarray(shape, dtype=np.float64) for shape in footprints]
        self._corners = np.array([shape[_FOUR % len(shape)] for shape in self._footprints])
        count = len(self._footprints)
        normal, offset = np.zeros((count, count, 2)), np.zeros((count, count))
        normal[:known, :known], offset[:known, :known] = self._normal, self._offset
        for j in range(known, count):
            for i in range(j):
                line = _separating_line(self._footprints[i], self._footprints[j])
                normal[i, j], offset[i, j] = line
                normal[j, i], offset[j, i] = -line[0], -line[1]
        self._normal, self._offset = normal, offset


def _separating_line(a: FloatArray, b: FloatArray) -> tuple[FloatArray, float]:
    """Unit normal and offset of the line with `a` on its negative and `b` on its positive side."""
    normal_a, gap_a = _widest_gap(a, b)
    normal_b, gap_b = _widest_gap(b, a)
    if gap_a >= gap_b:
        return normal_a, float((a @ normal_a).max())
    return -normal_b, -float((b @ normal_b).max())


def _widest_gap(a: FloatArray, b: FloatArray) -> tuple[FloatArray, float]:
    """Outward normal of the side of `a` with the largest distance from `b`, and that distance."""
    side = np.roll(a, -1, axis=0) - a
    outward = np.stack([side[:, 1], -side[:, 0]], -1) / np.linalg.norm(side, axis=1)[:, None]
    gap = (b @ outward.T).min(axis=0) - np.sum(a * outward, -1)
    best = int(np.argmax(gap))
    return outward[best], float(gap[best])
