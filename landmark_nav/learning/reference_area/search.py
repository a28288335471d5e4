"""
Correspondence of blobs and papers, and an approximate pose of the sweep.

Two papers give a pose: the height of a blob gives its range. All pairs of blobs with the distance
of their papers are tried, so that the effort is quadratic in papers and blobs; the other papers
then select the right pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from landmark_nav.arrays import BoolArray, IndexArray
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.reference_area.blobs import PaperBlobs
from landmark_nav.learning.reference_area.model import linearized, PaperPlaces, ReferenceAreaConfig
from landmark_nav.types import FloatArray

# Fewest papers; with two, a misplaced one is not detected.
LEAST_PAPERS = 3
# Sigma of a blob, whose outline is a pixel or two off.
_OUTLINE_SIGMA = 0.008
# Cost of a paper that should be in view and is not found, squared sigmas.
_MISSING = 25.0
# Squared residual at which the robust weight has fallen to a quarter.
_TAIL_WIDTH = 9.0
_MOST_PAIRS = 1500
_MOST_PLACES = 6
# Rounds of refinement of all poses, then of the best ones.
_ROUGH_ROUNDS, _FINE_ROUNDS = 2, 5
_MOST_REFINED = 150
# Greatest angle of a paper to the line of sight.
_FLATTEST_RAD = 1.4


@dataclass(frozen=True, eq=False)
class PaperPlace:
    """
    A pose that explains some blobs.

    `axis_pose` (3,) is that of the pan axis in map; `mount` (3,) is the height of the camera
    relative to the given one, and the tilt of the axis about x and y of the base; `blob` (papers,)
    is the index of each paper's blob, -1 for none; `cost` is in squared sigmas.
    """

    axis_pose: FloatArray
    mount: FloatArray
    blob: IndexArray
    cost: float


def papers_in_view(axis_xy: FloatArray, room: Room) -> BoolArray:
    """Whether anchors face positions (..., 2) and no wall is between, (..., anchors)."""
    center = np.array([paper.center[:2] for paper in room.anchors])
    way = axis_xy[..., None, :] - center
    facing = np.sum(way * room.normals[room.nearest_wall(center), :2], -1)
    seen = room.visible(axis_xy[..., None, :], np.broadcast_to(center, way.shape))
    return np.asarray(seen & (facing > np.cos(_FLATTEST_RAD) * np.linalg.norm(way, axis=-1)))


def find_places(
    blobs: Sequence[PaperBlobs], room: Room, eye_height_m: float, config: ReferenceAreaConfig
) -> list[PaperPlace]:
    """Distinct poses at which two papers or more fit some of their `blobs`, the best first."""
    problem = _Problem(blobs, room, eye_height_m, config)
    poses = problem.pair_places()
    if not len(poses):
        return []
    for _ in range(_ROUGH_ROUNDS):
        poses = problem.refine(poses)
    poses = poses[np.argsort(problem.judge(poses)[0])[:_MOST_REFINED]]
    for _ in range(_FINE_ROUNDS):
        poses = problem.refine(poses)
    cost, blob = problem.judge(poses)
    inside = room.contains(poses[:, :2])
    found: list[PaperPlace] = []
    for k in np.flatnonzero(inside)[np.argsort(cost[inside])]:
        off = np.array([p.axis_pose for p in found]).reshape(-1, 3) - poses[k, :3]
        alike = (np.hypot(off[:, 0], off[:, 1]) < 0.1) & (np.abs(wrap_rad(off[:, 2])) < 0.05)
        if not alike.any() and np.sum(blob[k] >= 0) >= min(2, len(blobs)):
            found.append(PaperPlace(poses[k, :3], poses[k, 3:], blob[k], float(cost[k])))
        if len(found) == _MOST_PLACES:
            break
    return found


class _Problem:
    """Blobs of all papers, padded; poses (n, 6) are axis pose and mount as in `PaperPlace`."""

    def __init__(
        self,
        blobs: Sequence[PaperBlobs],
        room: Room,
        eye_height_m: float,
        config: ReferenceAreaConfig,
    ) -> None:
        self._room, self._places = room, PaperPlaces.of(room)
        self._mount_sigma = np.array([config.height_sigma_m, *[config.horizon_sigma_rad] * 2])
        self._eye = np.array([eye_height_m, 0.0, 0.0])
        self._center_sigma_m = config.center_sigma_m
        self._center, self._height = self._places.center, self._places.size[:, 1]
        most = max(1, *map(len, blobs))
        # Middle azimuth, tangents of top and bottom.
        self._blobs = np.tile([0.0, 1.0, 0.0], (len(blobs), most, 1))
        self._misfit = np.full((len(blobs), most), np.inf)
        for k, found in enumerate(blobs):
            self._blobs[k, : len(found)] = _middle(found.edges)
            self._misfit[k, : len(found)] = found.misfit

    def pair_places(self) -> FloatArray:
        """Poses (n, 6) of all pairs of papers and their blobs."""
        azimuth, top, bottom = np.moveaxis(self._blobs, -1, 0)
        reach = self._height[:, None] / np.maximum(top - bottom, 1e-6)
        rise = reach * 0.5 * (top + bottom) - (self._center[:, 2:] - self._eye[0])
        ray = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
        good = np.isfinite(self._misfit)
        poses, costs = [], []
        for i, j in combinations(range(len(self._height)), 2):
            a = np.flatnonzero(good[i]).repeat(good[j].sum())
            b = np.tile(np.flatnonzero(good[j]), good[i].sum())
            apart = self._center[j, :2] - self._center[i, :2]
            distance = float(np.hypot(*apart))
            turn = azimuth[j, b] - azimuth[i, a]
            first, second = reach[i, a], reach[j, b]
            # The height of a cut blob is wrong, so its range is computed from the other one.
            half = np.sqrt(np.maximum(distance**2 - (first * np.sin(turn)) ** 2, 0.0))
            rest = np.sqrt(np.maximum(distance**2 - (second * np.sin(turn)) ** 2, 0.0))
            for near, far in (
                (first, second),
                (first, first * np.cos(turn) + half),
                (first, first * np.cos(turn) - half),
                (second * np.cos(turn) + rest, second),
                (second * np.cos(turn) - rest, second),
            ):
                one, other = near[:, None] * ray[i, a], far[:, None] * ray[j, b]
                pose, cost = self._place(i, j, one, other)
                cost[(near < 0.2) | (far < 0.2)] = np.inf
                cost += np.minimum((rise[i, a] / self._rise_sigma_m(first)) ** 2, _MISSING)
                cost += np.minimum((rise[j, b] / self._rise_sigma_m(second)) ** 2, _MISSING)
                poses.append(pose)
                costs.append(cost + self._misfit[i, a] + self._misfit[j, b])
        if not poses:
            return np.zeros((0, 6))
        pose, cost = np.concatenate(poses), np.concatenate(costs)
        possible = self._room.contains(pose[:, :2]) & np.isfinite(cost)
        order = np.argsort(cost[possible])[:_MOST_PAIRS]
        return np.pad(pose[possible][order], ((0, 0), (0, 3)))

    def _rise_sigma_m(self, reach: FloatArray) -> FloatArray:
        """Approximate sigma of the height of blobs at a range."""
        by_mount = np.hypot(self._mount_sigma[0], self._mount_sigma[1] * reach)
        return np.asarray(np.hypot(0.05 + 0.05 * reach, by_mount))

    def _place(
        self, i: int, j: int, first: FloatArray, second: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Rigid alignment of two observed points (n, 2) with the places of papers; its cost."""
        seen, hung = second - first, self._center[j, :2] - self._center[i, :2]
        heading = np.arctan2(hung[1], hung[0]) - np.arctan2(seen[:, 1], seen[:, 0])
        turned = np.einsum('nij,nj->ni', se2.rotation(heading), 0.5 * (first + second))
        axis = 0.5 * (self._center[i, :2] + self._center[j, :2]) - turned
        miss = np.linalg.norm(seen, axis=1) - np.hypot(*hung)
        reach = np.linalg.norm([*first.T, *second.T], axis=0)
        return np.column_stack([axis, wrap_rad(heading)]), (miss / (0.05 + 0.05 * reach)) ** 2

    def refine(self, poses: FloatArray) -> FloatArray:
        """One least-squares step of all poses (n, 6) to the best blobs of each."""
        residual, cost, _ = self._compare(poses)
        weight = (1.0 + cost / _TAIL_WIDTH) ** -2.0 * (cost < _MISSING)
        weight *= papers_in_view(poses[:, :2], self._room)
        _, jacobian = linearized(self._predicted, poses)
        jacobian = jacobian.reshape(*poses.shape, -1, 3) / self._sigma(poses)[:, None, :, None]
        prior = np.concatenate([np.full(3, 1e-3), self._mount_sigma**-2.0])
        normal = np.einsum('np,nipk,njpk->nij', weight, jacobian, jacobian) + np.diag(prior)
        pull = np.einsum('np,nipk,npk->ni', weight, jacobian, residual)
        pull[:, 3:] -= prior[3:] * poses[:, 3:]
        step = np.linalg.solve(normal, pull[..., None])[..., 0]
        return np.asarray(poses + np.clip(step, -0.5, 0.5))

    def judge(self, poses: FloatArray) -> tuple[FloatArray, IndexArray]:
        """Cost (n,) of poses and the blob (n, papers) of each paper, -1 for none."""
        _, cost, blob = self._compare(poses)
        seen = papers_in_view(poses[:, :2], self._room)
        # A hidden paper costs a little less than a missing one; without a cost, the best pose
        # would see none.
        each = np.where(seen, np.minimum(cost, _MISSING), 0.8 * _MISSING)
        by_mount = np.sum((poses[:, 3:] / self._mount_sigma) ** 2, 1)
        return each.sum(1) + by_mount, np.where(seen & (cost < _MISSING), blob, -1)

    def _predicted(self, poses: FloatArray) -> FloatArray:
        """Middle azimuths and tangents of top and bottom at poses (..., 6), (..., 3 papers)."""
        mount = self._eye + poses[..., None, 3:]
        seen = _middle(self._places.outlines(poses[..., None, :3], mount))
        return seen.reshape(*poses.shape[:-1], -1)

    def _sigma(self, poses: FloatArray) -> FloatArray:
        """Sigma of the blobs of each paper at poses (n, 6), (n, papers)."""
        away = self._center[:, :2] - poses[:, None, :2]
        reach = np.maximum(np.hypot(away[..., 0], away[..., 1]), self._center_sigma_m)
        return np.hypot(_OUTLINE_SIGMA, self._center_sigma_m / np.maximum(reach, 1e-3))

    def _compare(self, poses: FloatArray) -> tuple[FloatArray, FloatArray, IndexArray]:
        """Residuals (n, papers, 3) to the best blob, their cost and its index."""
        predicted = self._predicted(poses).reshape(len(poses), -1, 1, 3)
        residual = self._blobs - predicted
        residual[..., 0] = wrap_rad(residual[..., 0])
        residual /= self._sigma(poses)[..., None, None]
        cost = np.sum(residual**2, -1) + self._misfit
        blob = np.argmin(cost, axis=-1)
        best = np.take_along_axis(residual, blob[..., None, None], -2)[..., 0, :]
        return best, np.take_along_axis(cost, blob[..., None], -1)[..., 0], blob


def _middle(edges: FloatArray) -> FloatArray:
    """Middle azimuth, tangents of top and bottom (..., 3) of edges (..., 4)."""
    right, left, bottom, top = np.moveaxis(edges, -1, 0)
    return np.stack([0.5 * (right + left), top, bottom], -1)
