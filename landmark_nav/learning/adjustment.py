"""
Joint least squares of landmarks and panorama poses: a small bundle adjustment.

What landmarks share (the pose errors of the panoramas) is kept apart from what each has alone,
so that the map can say both (Triggs et al., Bundle Adjustment, 2000, for the Schur complement).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.stereo import Sighting
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import FloatArray, Panorama

__all__ = ['Adjustment', 'AdjustmentConfig', 'adjust']

# x, y, z, heading of each panorama; after all of them, how far things hang off the walls.
_POSE = 4
_MAX_ITERATIONS = 15
# Squared misfit at which a landmark's weight has fallen to a quarter, at first and in the end.
_DOUBT_AT_FIRST, _DOUBT = 100.0, 6.0


@dataclass(frozen=True)
class AdjustmentConfig:
    """What is known beside the sightings."""

    azimuth_sigma_rad: float = parameter(
        1.5e-4, 'what a panorama adds to each azimuth', minimum=0, maximum=0.1
    )
    tangent_sigma: float = parameter(
        1e-3, 'what a panorama adds to each tangent of elevation', minimum=0, maximum=0.1
    )
    hanging_sigma_m: float = parameter(
        0.015, 'how differently far from the wall things hang', minimum=1e-4, maximum=1
    )
    common_hanging_sigma_m: float = parameter(
        0.015, 'how far from the wall things hang on average', minimum=1e-4, maximum=1
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_parameters(self)


@dataclass(frozen=True, eq=False)
class Adjustment:
    """
    Landmarks and panoramas after the adjustment.

    Parameters
    ----------
    positions : ndarray, shape (n, 3)
        Landmarks in map, metres.
    own_covariance : ndarray, shape (n, 3, 3)
        What the error of each has alone.
    shared_loading : ndarray, shape (n, 3, m)
        The rest, as unit-variance factors that all have in common.
    poses, pose_covariance : ndarray, shape (views, 4), (views, 4, 4)
        x, y, z, heading of the panoramas.
    off_wall_m : ndarray, shape (n,)
        How far before its wall each landmark lies.
    chi_square : ndarray, shape (n,)
        Misfit of its sightings and its wall.

    """

    positions: FloatArray
    own_covariance: FloatArray
    shared_loading: FloatArray
    poses: FloatArray
    pose_covariance: FloatArray
    off_wall_m: FloatArray
    chi_square: FloatArray


def adjust(
    sightings: Sequence[Sequence[Sighting]],
    walls: Sequence[int],
    start: FloatArray,
    panoramas: Sequence[Panorama],
    room: Room,
    config: AdjustmentConfig,
) -> Adjustment:
    """
    Adjust landmarks and panorama poses to all sightings.

    Parameters
    ----------
    sightings : sequence of sequences
        For each of n landmarks, where the panoramas show it.
    walls : sequence of int
        Wall of each landmark.
    start : ndarray, shape (n, 3)
        Positions to start from.
    panoramas : sequence of Panorama
        With prior poses and covariances.
    room : Room
        The walls; what hangs on them lies near them, not on them.
    config : AdjustmentConfig
        Prior standard deviations.

    Returns
    -------
    Adjustment

    """
    problem = _Problem(sightings, walls, panoramas, room, config)
    points, shared = start.copy(), problem.prior
    for step in range(_MAX_ITERATIONS):
        # False matches, and what hangs off the walls, must bend neither their neighbours nor the
        # poses, even where they are many: a weight that falls faster than the pull grows (Geman
        # and McClure, 1987), stricter with each step, as the poses explain more of the misfit.
        doubt = max(_DOUBT_AT_FIRST / 2**step, _DOUBT)
        weight = (1.0 + problem.misfit(points, shared) / doubt) ** -2.0
        equations = problem.normal_equations(points, shared, weight)
        point_step, shared_step = equations.solve()
        points, shared = points + point_step, shared + shared_step
        if step > 4 and max(np.abs(point_step).max(), np.abs(shared_step).max()) < 1e-7:
            break
    views = len(panoramas)
    covariance = equations.shared_covariance()
    diagonal = np.arange(views)
    return Adjustment(
        points,
        np.asarray(np.linalg.inv(equations.h_xx), dtype=np.float64),
        -equations.gain @ np.linalg.cholesky(covariance),
        shared[:-1].reshape(views, _POSE),
        covariance[:-1, :-1].reshape(views, _POSE, views, _POSE)[diagonal, :, diagonal],
        problem.off_wall(points),
        problem.misfit(points, shared),
    )


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """Blocks of landmarks (x) and of what they share (s): ``H d = b``."""

    h_xx: FloatArray
    h_xs: FloatArray
    h_ss: FloatArray
    b_x: FloatArray
    b_s: FloatArray

    @property
    def gain(self) -> FloatArray:
        """How the shared unknowns move each landmark, (n, 3, m), with the opposite sign."""
        return np.asarray(np.linalg.solve(self.h_xx, self.h_xs), dtype=np.float64)

    def _schur(self) -> FloatArray:
        return np.asarray(self.h_ss - np.einsum('nip,niq->pq', self.h_xs, self.gain))

    def solve(self) -> tuple[FloatArray, FloatArray]:
        """Steps of landmarks (n, 3) and shared unknowns (m,)."""
        alone = np.linalg.solve(self.h_xx, self.b_x[..., None])[..., 0]
        rhs = self.b_s - np.einsum('nip,ni->p', self.h_xs, alone)
        shared = np.linalg.solve(self._schur(), rhs)
        return alone - self.gain @ shared, shared

    def shared_covariance(self) -> FloatArray:
        """Covariance of the shared unknowns, (m, m)."""
        return np.asarray(np.linalg.inv(self._schur()))


class _Problem:
    """The measurements; unknowns are points (n, 3) and the shared (4 * views + 1,)."""

    def __init__(
        self,
        sightings: Sequence[Sequence[Sighting]],
        walls: Sequence[int],
        panoramas: Sequence[Panorama],
        room: Room,
        config: AdjustmentConfig,
    ) -> None:
        flat = [(k, s) for k, group in enumerate(sightings) for s in group]
        self._landmark = np.array([k for k, _ in flat], dtype=np.intp)
        self._view = np.array([s.panorama for _, s in flat], dtype=np.intp)
        self._seen = np.array([(s.azimuth_rad, s.tangent) for _, s in flat])
        own = np.array([(s.sigma_azimuth_rad, s.sigma_tangent) for _, s in flat])
        self._sigma = np.hypot(own, [config.azimuth_sigma_rad, config.tangent_sigma])
        self._count, self._views = len(sightings), len(panoramas)

        self._normal = room.normals[np.asarray(walls, dtype=np.intp)]
        starts = np.array([room.walls[w].start for w in walls])
        self._level = np.sum(self._normal[:, :2] * starts, 1)
        self._hanging_sigma = config.hanging_sigma_m

        poses = np.array([(*p.center_map, p.heading_rad) for p in panoramas])
        self.prior = np.append(poses.ravel(), 0.0)
        self._information = np.zeros((len(self.prior), len(self.prior)))
        for i, panorama in enumerate(panoramas):
            part = slice(_POSE * i, _POSE * (i + 1))
            self._information[part, part] = np.linalg.inv(
                panorama.covariance + 1e-12 * np.eye(_POSE)
            )
        self._information[-1, -1] = config.common_hanging_sigma_m**-2

    def off_wall(self, points: FloatArray) -> FloatArray:
        """How far before their walls points (n, 3) lie, metres."""
        return np.asarray(np.sum(points * self._normal, 1) - self._level)

    def misfit(self, points: FloatArray, shared: FloatArray) -> FloatArray:
        """Squared misfit of each landmark, in standard deviations, (n,)."""
        residual = self._residual(points, shared)[0] / self._sigma
        wall = (shared[-1] - self.off_wall(points)) / self._hanging_sigma
        sums = np.bincount(self._landmark, np.sum(residual**2, 1), self._count)
        return np.asarray(sums + wall**2)

    def normal_equations(
        self, points: FloatArray, shared: FloatArray, weight: FloatArray
    ) -> _NormalEquations:
        """Linearize; `weight` (n,) scales all measurements of a landmark."""
        residual, by_point, by_pose = self._residual(points, shared)
        scale = np.sqrt(weight[self._landmark])[:, None] / self._sigma
        r = residual * scale
        jx, jp = by_point * scale[..., None], by_pose * scale[..., None]

        wall_weight = weight / self._hanging_sigma**2
        wall_pull = wall_weight * (shared[-1] - self.off_wall(points))
        h_xx = _sum_by(self._landmark, np.einsum('nki,nkj->nij', jx, jx), self._count)
        h_xx += np.einsum('n,ni,nj->nij', wall_weight, self._normal, self._normal)
        b_x = _sum_by(self._landmark, np.einsum('nki,nk->ni', jx, r), self._count)
        b_x += wall_pull[:, None] * self._normal

        pair = self._landmark * self._views + self._view
        h_xp = _sum_by(pair, np.einsum('nki,nkj->nij', jx, jp), self._count * self._views)
        h_xp = h_xp.reshape(self._count, self._views, 3, _POSE).transpose(0, 2, 1, 3)
        h_xs = np.concatenate(
            [
                h_xp.reshape(self._count, 3, -1),
                -(wall_weight[:, None] * self._normal)[..., None],
            ],
            2,
        )
        h_ss = self._information.copy()
        b_s = self._information @ (self.prior - shared)
        blocks = _sum_by(self._view, np.einsum('nki,nkj->nij', jp, jp), self._views)
        for i, block in enumerate(blocks):
            part = slice(_POSE * i, _POSE * (i + 1))
            h_ss[part, part] += block
        b_s[:-1] += _sum_by(self._view, np.einsum('nki,nk->ni', jp, r), self._views).ravel()
        h_ss[-1, -1] += wall_weight.sum()
        b_s[-1] -= wall_pull.sum()
        return _NormalEquations(h_xx, h_xs, h_ss, b_x, b_s)

    def _residual(
        self, points: FloatArray, shared: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Azimuth and tangent residuals (k, 2), derivatives by point and pose of the model."""
        poses = shared[:-1].reshape(-1, _POSE)[self._view]
        d = points[self._landmark] - poses[:, :3]
        reach = np.hypot(d[:, 0], d[:, 1])
        residual = self._seen - np.stack(
            [np.arctan2(d[:, 1], d[:, 0]) - poses[:, 3], d[:, 2] / reach], 1
        )
        residual[:, 0] = wrap_rad(residual[:, 0])
        by_point = np.zeros((len(d), 2, 3))
        by_point[:, 0, 0] = -d[:, 1] / reach**2
        by_point[:, 0, 1] = d[:, 0] / reach**2
        by_point[:, 1, :2] = -(d[:, 2] / reach**3)[:, None] * d[:, :2]
        by_point[:, 1, 2] = 1.0 / reach
        by_pose = np.concatenate([-by_point, np.zeros((len(d), 2, 1))], 2)
        by_pose[:, 0, 3] = -1.0
        return residual, by_point, by_pose


def _sum_by(index: npt.NDArray[np.intp], values: FloatArray, count: int) -> FloatArray:
    """Sum values (k, ...) into rows (count, ...) by their index (k,)."""
    out = np.zeros((count, *values.shape[1:]))
    np.add.at(out, index, values)
    return out
