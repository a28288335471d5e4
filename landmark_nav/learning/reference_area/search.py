"""
Correspondence of blobs and papers, and an approximate pose of the sweep.

Two papers give a pose: the height of a blob gives its range. All pairs of blobs with the distance
of their papers are tried, so that the effort is quadratic in papers and blobs; the other papers
then select the right pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.reference_area.blobs import PaperBlobs
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.types import FloatArray

# Fewest papers; with two, a misplaced one is not detected.
LEAST_PAPERS = 3

# Sigmas of a blob, whose outline is a pixel or two off.
_DIRECTION_SIGMA = 0.008
_OUTLINE_SIGMA = 0.008

# Cost of a paper that should be in view and is not found, squared sigmas.
_MISSING = 25.0
# Squared residual at which the robust weight has fallen to a quarter.
_TAIL_WIDTH = 9.0

_MOST_PAIRS = 1500
_MOST_PLACES = 6
# Rounds of refinement of all poses, with factors on the sigmas above; then rounds of the best ones
# with factor 1.
_ROUGH_ROUNDS, _FINE_ROUNDS = (4.0, 2.0), 5
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
    blob: npt.NDArray[np.intp]
    cost: float


def papers_in_view(axis_xy: FloatArray, room: Room) -> npt.NDArray[np.bool_]:
    """Whether papers face positions (..., 2) and no wall is between, (..., papers)."""
    center = np.array([paper.center[:2] for paper in room.papers])
    way = axis_xy[..., None, :] - center
    facing = np.sum(way * room.normals[room.nearest_wall(center), :2], -1)
    seen = room.visible(axis_xy[..., None, :], np.broadcast_to(center, way.shape))
    return np.asarray(seen & (facing > np.cos(_FLATTEST_RAD) * np.linalg.norm(way, axis=-1)))


def find_places(
    blobs: list[PaperBlobs], room: Room, eye_height_m: float, config: ReferenceAreaConfig
) -> list[PaperPlace]:
    """
    Poses in the room at which two or more papers fit some blobs.

    Parameters
    ----------
    blobs : list of PaperBlobs
        Candidates for each paper of the room.
    config : ReferenceAreaConfig
        Sigmas of height and tilt of the camera.

    Returns
    -------
    list of PaperPlace
        Distinct poses, the best first.
    """
    problem = _Problem(blobs, room, eye_height_m, config)
    poses = problem.pair_places()
    if not len(poses):
        return []
    for scale in _ROUGH_ROUNDS:
        poses = problem.refine(poses, scale)
    poses = poses[np.argsort(problem.judge(poses)[0])[:_MOST_REFINED]]
    for _ in range(_FINE_ROUNDS):
        poses = problem.refine(poses, 1.0)
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
    """
    Blobs of all papers in one padded table (papers, blobs).

    Poses have six values: x, y and heading of the pan axis, then height and tilts as in
    `PaperPlace`, which have a prior.
    """

    def __init__(
        self,
        blobs: list[PaperBlobs],
        room: Room,
        eye_height_m: float,
        config: ReferenceAreaConfig,
    ) -> None:
        self._room = room
        self._mount_sigma = np.array([config.height_sigma_m, *[config.horizon_sigma_rad] * 2])
        self._center = np.array([p.center for p in room.papers]) - [0.0, 0.0, eye_height_m]
        self._height = np.array([p.height for p in room.papers])
        most = max(1, max(len(b.misfit) for b in blobs))

        def table(values: list[FloatArray], fill: float) -> FloatArray:
            return np.array([np.pad(v, (0, most - len(v)), constant_values=fill) for v in values])

        self._azimuth = table([b.azimuth_rad for b in blobs], 0.0)
        self._top = table([b.tangent[:, 0] for b in blobs], 1.0)
        self._bottom = table([b.tangent[:, 1] for b in blobs], 0.0)
        self._misfit = table([b.misfit for b in blobs], np.inf)

    def pair_places(self) -> FloatArray:
        """Poses (n, 6) of all pairs of papers and their blobs."""
        reach = self._height[:, None] / np.maximum(self._top - self._bottom, 1e-6)
        rise = reach * 0.5 * (self._top + self._bottom) - self._center[:, 2:]
        good = np.isfinite(self._misfit)
        poses, costs = [], []
        for i, j in combinations(range(len(self._height)), 2):
            a = np.flatnonzero(good[i]).repeat(good[j].sum())
            b = np.tile(np.flatnonzero(good[j]), good[i].sum())
            apart = self._center[j, :2] - self._center[i, :2]
            distance = float(np.hypot(*apart))
            turn = self._azimuth[j, b] - self._azimuth[i, a]
            first, second = reach[i, a], reach[j, b]
            # The height of a cut blob is wrong, so its range is computed from the other one.
            half = np.sqrt(np.maximum(distance**2 - (first * np.sin(turn)) ** 2, 0.0))
            other = np.sqrt(np.maximum(distance**2 - (second * np.sin(turn)) ** 2, 0.0))
            for near, far in (
                (first, second),
                (first, first * np.cos(turn) + half),
                (first, first * np.cos(turn) - half),
                (second * np.cos(turn) + other, second),
                (second * np.cos(turn) - other, second),
            ):
                pose, cost = self._place(i, j, a, b, near, far)
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
        self,
        i: int,
        j: int,
        a: npt.NDArray[np.intp],
        b: npt.NDArray[np.intp],
        near: FloatArray,
        far: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Rigid alignment of two observed points with the places of the papers."""
        first = near[:, None] * _unit(self._azimuth[i, a])
        second = far[:, None] * _unit(self._azimuth[j, b])
        seen, hung = second - first, self._center[j, :2] - self._center[i, :2]
        heading = np.arctan2(hung[1], hung[0]) - np.arctan2(seen[:, 1], seen[:, 0])
        turned = np.einsum('nij,nj->ni', se2.rotation(heading), 0.5 * (first + second))
        axis = 0.5 * (self._center[i, :2] + self._center[j, :2]) - turned
        miss = np.linalg.norm(seen, axis=1) - np.hypot(*hung)
        cost = (miss / (0.05 + 0.05 * np.hypot(near, far))) ** 2
        cost[(near < 0.2) | (far < 0.2)] = np.inf
        return np.column_stack([axis, wrap_rad(heading)]), cost

    def refine(self, poses: FloatArray, scale: float) -> FloatArray:
        """One least-squares step of all poses (n, 6) to the best blobs of each."""
        residual, cost, _ = self._compare(poses, scale)
        weight = (1.0 + cost / _TAIL_WIDTH) ** -2.0 * (cost < _MISSING)
        weight *= papers_in_view(poses[:, :2], self._room)
        offset, ahead, level = self._seen_from(poses)
        reach = np.maximum(np.linalg.norm(offset, axis=-1), 0.1)
        jacobian = np.zeros((*reach.shape, 3, poses.shape[1]))
        jacobian[..., 0, 0] = offset[..., 1] / reach**2
        jacobian[..., 0, 1] = -offset[..., 0] / reach**2
        jacobian[..., 0, 2] = -1.0
        jacobian[..., 0, 4:] = (level / reach**2)[..., None] * ahead
        for row, up in ((1, 0.5), (2, -0.5)):
            rise = level + up * self._height
            jacobian[..., row, :2] = (rise / reach**3)[..., None] * offset
            jacobian[..., row, 3] = -1.0 / reach
            jacobian[..., row, 4] = -ahead[..., 1] / reach
            jacobian[..., row, 5] = ahead[..., 0] / reach
        jacobian /= np.array([_DIRECTION_SIGMA, _OUTLINE_SIGMA, _OUTLINE_SIGMA])[:, None]
        prior = np.concatenate([np.full(3, 1e-3), self._mount_sigma**-2.0])
        normal = np.einsum('np,npki,npkj->nij', weight, jacobian, jacobian) + np.diag(prior)
        pull = np.einsum('np,npki,npk->ni', weight, jacobian, residual)
        pull[:, 3:] -= prior[3:] * poses[:, 3:]
        step = np.linalg.solve(normal, pull[..., None])[..., 0]
        return np.asarray(poses + np.clip(step, -0.5, 0.5))

    def judge(self, poses: FloatArray) -> tuple[FloatArray, npt.NDArray[np.intp]]:
        """Cost (n,) of poses and the blob (n, papers) of each paper, -1 for none."""
        _, cost, blob = self._compare(poses, 1.0)
        seen = papers_in_view(poses[:, :2], self._room)
        # A hidden paper costs a little less than a missing one; without a cost, the best pose
        # would see none.
        each = np.where(seen, np.minimum(cost, _MISSING), 0.8 * _MISSING)
        by_mount = np.sum((poses[:, 3:] / self._mount_sigma) ** 2, 1)
        return each.sum(1) + by_mount, np.where(seen & (cost < _MISSING), blob, -1)

    def _seen_from(self, poses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Vectors to papers in map and base (n, papers, 2), and their heights above the camera."""
        offset = self._center[:, :2] - poses[:, None, :2]
        ahead = offset @ se2.rotation(poses[:, 2])
        return offset, ahead, self._center[:, 2] - poses[:, 3, None]

    def _compare(
        self, poses: FloatArray, scale: float
    ) -> tuple[FloatArray, FloatArray, npt.NDArray[np.intp]]:
        """Residuals (n, papers, 3) to the best blob, their cost and its index."""
        _, ahead, level = self._seen_from(poses)
        reach = np.maximum(np.linalg.norm(ahead, axis=-1), 0.1)
        roll, pitch = poses[:, 4, None], poses[:, 5, None]
        azimuth = np.arctan2(ahead[..., 1] + roll * level, ahead[..., 0] - pitch * level)
        tilted = level + pitch * ahead[..., 0] - roll * ahead[..., 1]
        rows = [(tilted + up * self._height) / reach for up in (0.5, -0.5)]
        residual = np.stack(
            [
                wrap_rad(self._azimuth - azimuth[..., None]) / _DIRECTION_SIGMA,
                (self._top - rows[0][..., None]) / _OUTLINE_SIGMA,
                (self._bottom - rows[1][..., None]) / _OUTLINE_SIGMA,
            ],
            -1,
        )
        cost = np.sum(residual**2, -1) / scale**2 + self._misfit
        blob = np.argmin(cost, axis=-1)
        best = np.take_along_axis(residual, blob[..., None, None], -2)[..., 0, :]
        return best, np.take_along_axis(cost, blob[..., None], -1)[..., 0], blob


def _unit(azimuth_rad: FloatArray) -> FloatArray:
    return np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], -1)
