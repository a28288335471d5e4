"""
The measurements of an adjustment, linearized, and their normal equations.

Unknowns are the landmarks and shared ones: poses of panoramas, the mean distance of objects from
each wall and from each section of a wall, the calibration of the robot, and tilt and waves of each
sweep. Landmarks are eliminated first (Schur complement; Triggs et al., Bundle Adjustment, 2000):
they are coupled through the shared unknowns only, so their part is a stack of 3 x 3 blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.calibration import LENS, NAMES
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import rotation_rpy
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.calibration.sweep_calibration import FAR_M, tilt_axes
from landmark_nav.learning.least_squares import covariance_of, solve_positive
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement
from landmark_nav.parameters import Config
from landmark_nav.types import FloatArray, Panorama


@dataclass(frozen=True)
class AdjustmentConfig(Config):
    """
    Expected sigmas, which the residuals refine.

    docs/decisions.md (stereo, adjustment, election) compares lengths of wall sections and robust
    weights; the other values are chosen by hand.
    """

    # Sigma that a panorama adds to each azimuth.
    azimuth_sigma_rad: float = 1.5e-4
    # Sigma that a panorama adds to each tangent of elevation.
    tangent_sigma: float = 1e-3
    # Sigma that two panoramas add to the log ratio of their distances by depth from scale.
    nearness_sigma: float = 1.5e-3
    # Sigma of the tilt of each sweep's pan axis; 0 does not estimate it.
    tilt_sigma_rad: float = 0.0
    # Sigma of errors that azimuths of one panorama share, in waves of a quarter turn and longer; 0
    # does not estimate them.
    wave_sigma_rad: float = 0.0
    # Sigma of the distance from the wall within one section of it.
    relief_sigma_m: float = 0.015
    # Sigma of the distance from the wall between sections.
    hanging_sigma_m: float = 0.015
    # Length of a section of wall, within which errors are correlated, as on a poster.
    hanging_length_m: float = 0.6
    # Sigma of the mean distance of objects from all walls.
    common_hanging_sigma_m: float = 0.015
    # Sigma of the position of a wall in the plan.
    wall_sigma_m: float = 0.005
    # Weight of the expected sigmas of panoramas and of relief, in measurements.
    camera_weight: float = 1.0
    # Weight of the expected sigmas of their poses, in measurements.
    place_weight: float = 10.0
    # Weight of the expected sigmas of walls and of distances from them, in measurements.
    room_weight: float = 0.05


# Shared unknowns: x, y, z, heading of each panorama; distance of objects from each wall, then from
# each section; then the calibration, tilts and waves.
_POSE = 4
CALIBRATED = ('center_x', 'center_y', 'camera_tilt', 'focal_scale', 'axis_roll', 'axis_pitch')
_OFFSET = slice(CALIBRATED.index('center_x'), CALIBRATED.index('center_y') + 1)
# Highest number of waves per turn of errors of azimuths: lenses, bearings, seams.
_WAVES = 4
# Least sigma of the calibration, m, rad or relative.
_LEAST_ERROR = 1e-7
# Least range of a landmark, m.
_NEAREST_M = 0.01
# Information about a landmark in all directions, relative to that of its wall.
_WEAK = 1e-7


@dataclass(frozen=True, eq=False)
class Linearized:
    """
    Residuals at landmarks `points` (n, 3) and shared unknowns (m,), and the model's derivatives.

    `seen` (k, 2) are residuals of azimuths and tangents, with derivatives by the landmark
    `by_point` (k, 2, 3) and by the shared unknowns of its view `by_view` (k, 2, c); `wall` (n,)
    are residuals of the distances from walls.
    """

    points: FloatArray
    shared: FloatArray
    seen: FloatArray
    wall: FloatArray
    by_point: FloatArray
    by_view: FloatArray


class Weights(NamedTuple):
    """
    Information of measurements `seen` (k, 2) and of walls `wall` (n,), and sigmas `spread` (5,).

    `spread` are factors on the sigmas of panoramas in plan and in height, and sigmas of the
    distance of objects from all walls, from each wall, and from each section.
    """

    seen: FloatArray
    wall: FloatArray
    spread: FloatArray


class Group(NamedTuple):
    """
    Landmarks (g,) that depend on the same shared unknowns `columns` (p,), and their measurements.

    `rows` (r,) are the measurements, in the order of their landmarks, which are numbers `local`
    (r,) of the group; `place` (r, c) are the unknowns of each view among `columns`.
    """

    landmarks: IndexArray
    columns: IndexArray
    rows: IndexArray
    local: IndexArray
    place: IndexArray

    def by_columns(self, at: Linearized) -> FloatArray:
        """Derivatives (r, 2, p) of the measurements by the shared unknowns."""
        out = np.zeros((len(self.rows), 2, len(self.columns)))
        by_view = at.by_view[self.rows].swapaxes(1, 2)
        out[np.arange(len(self.rows))[:, None], :, self.place] = by_view
        return out


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """
    Blocks of landmarks (x) and of shared unknowns (s): ``H d = b``.

    `h_xs` (g, 3, p) are those of each group.
    """

    groups: Sequence[Group]
    h_xx: FloatArray
    h_xs: Sequence[FloatArray]
    h_ss: FloatArray
    b_x: FloatArray
    b_s: FloatArray

    def damped(self, by: float) -> NormalEquations:
        """Return the equations with a share of the diagonals added (Levenberg-Marquardt)."""
        if not by:
            return self
        own = self.h_xx * (1.0 + by * np.eye(3))
        return replace(self, h_xx=own, h_ss=self.h_ss + by * np.diag(np.diag(self.h_ss)))

    @cached_property
    def own_covariance(self) -> FloatArray:
        """Covariance (n, 3, 3) of each landmark for fixed shared unknowns."""
        return np.asarray(np.linalg.inv(self.h_xx), dtype=np.float64)

    @cached_property
    def gain(self) -> list[FloatArray]:
        """Minus the derivatives (g, 3, p) of the landmarks of groups by the shared unknowns."""
        return [
            self.own_covariance[group.landmarks] @ h_xs
            for group, h_xs in zip(self.groups, self.h_xs, strict=True)
        ]

    def by_factors(self, root: FloatArray, count: int) -> FloatArray:
        """Derivatives (count, 3, q) of the first landmarks by factors (m, q) of the unknowns."""
        out = np.zeros((count, 3, root.shape[1]))
        for group, gain in zip(self.groups, self.gain, strict=True):
            which = group.landmarks < count
            out[group.landmarks[which]] = -gain[which] @ root[group.columns]
        return out

    @cached_property
    def _schur(self) -> FloatArray:
        left = self.h_ss.copy()
        for group, h_xs, gain in zip(self.groups, self.h_xs, self.gain, strict=True):
            size = len(group.columns)
            flat, flat_gain = h_xs.reshape(-1, size), gain.reshape(-1, size)
            left[np.ix_(group.columns, group.columns)] -= flat.T @ flat_gain
        return np.asarray(left)

    def solve(self) -> tuple[FloatArray, FloatArray]:
        """Steps of landmarks (n, 3) and shared unknowns (m,)."""
        points = (self.own_covariance @ self.b_x[..., None])[..., 0]
        rhs = self.b_s.copy()
        for group, h_xs in zip(self.groups, self.h_xs, strict=True):
            rhs[group.columns] -= np.tensordot(points[group.landmarks], h_xs)
        shared = solve_positive(self._schur, rhs)
        for group, gain in zip(self.groups, self.gain, strict=True):
            points[group.landmarks] -= gain @ shared[group.columns]
        return points, shared

    @cached_property
    def shared_covariance(self) -> FloatArray:
        """Covariance (m, m) of the shared unknowns."""
        return covariance_of(self._schur)


class Problem:
    """
    Measurements of n landmarks, their walls, and the priors of the panoramas.

    `own_sigma` (k, 2) are the sigmas of each measurement by matching; `landmark` and `view` (k,)
    are its indices. Landmarks off the walls, -1, have planes of their own, with `normals` (n, 3)
    through `start` (n, 3).
    """

    def __init__(
        self,
        measurements: Sequence[Sequence[PatchMeasurement]],
        walls: Sequence[int],
        panoramas: Sequence[Panorama],
        places: FloatArray,
        room: Room,
        normals: FloatArray,
        start: FloatArray,
        config: AdjustmentConfig,
    ) -> None:
        """Collect all that is constant during the iteration."""
        flat = [(k, s) for k, group in enumerate(measurements) for s in group]
        self.landmark = np.array([k for k, _ in flat], dtype=np.intp)
        self.view = np.array([s.panorama for _, s in flat], dtype=np.intp)
        self.own_sigma = np.array([(s.sigma_azimuth_rad, s.sigma_tangent) for _, s in flat])
        self.count, self.views = len(measurements), len(panoramas)
        self._seen = np.array([(s.azimuth_rad, s.tangent) for _, s in flat])

        wall = np.asarray(walls, dtype=np.intp)
        self.on_wall = wall >= 0
        self.normal = np.where(self.on_wall[:, None], room.normals[wall], normals)
        starts = np.array([room.walls[w].start for w in walls])
        starts[~self.on_wall] = start[~self.on_wall, :2]
        self._level = np.sum(self.normal[:, :2] * starts, 1)

        poses = np.array([(*p.center_map, p.heading_rad) for p in panoramas])
        section = wall_sections(start, walls, room, config.hanging_length_m)
        # Indicators of the wall and the section of each landmark: (n, walls + sections).
        self._wall_design = self.on_wall[:, None] * np.hstack(
            [np.eye(len(room.walls))[wall], np.eye(int(section.max()) + 1)[section]]
        )
        plane = (np.arange(self._wall_design.shape[1]) < len(room.walls)).astype(np.float64)
        # A wall with a given sigma has that; for the others one sigma is estimated.
        given = np.zeros(len(plane))
        given[: len(room.walls)] = [wall.sigma_m or 0.0 for wall in room.walls]
        self._given_wall_covariance = np.diag(given**2)
        alone = plane * (given == 0.0)
        # Patterns of the covariance: common to all walls, of each wall, of each section.
        self._wall_patterns = np.outer(plane, plane), np.diag(alone), np.diag(1.0 - plane)
        self._tilt_axes, self._rises, known, self._calibration, made_with = _calibration(panoramas)
        if len(known):
            # Corrections of panoramas are for an eccentric camera that sees the walls of the room.
            views = poses[self.view]
            reach, _ = room.raycast(views[:, :2], self._seen[:, 0] + views[:, 3])
            by_errors = self._by_errors(np.minimum(reach, FAR_M))
            self._corrected = np.einsum('kic,kc->ki', by_errors, made_with[self.view])
        # Warp of each panorama: its tilt, and waves of its azimuths.
        waves = [config.wave_sigma_rad / np.sqrt(_WAVES)] * 2 * _WAVES
        sigma = np.array([config.tilt_sigma_rad] * 2 + waves)
        self._warps = np.flatnonzero(sigma)
        self._warp_variance = np.kron(np.eye(self.views), np.diag(sigma[self._warps] ** 2))
        warps = np.zeros(len(self._warp_variance))
        self.prior = np.concatenate([poses.ravel(), np.zeros(len(plane)), known, warps])
        self.pose_part = slice(0, poses.size)
        self._walls = slice(poses.size, poses.size + len(plane))
        self.calibration_part = slice(self._walls.stop, self._walls.stop + len(known))
        self._warped = slice(self.calibration_part.stop, len(self.prior))
        self._places = places
        self._height = np.arange(poses.size) % _POSE == 2
        # Shared unknowns (views, c) that the measurements of each view depend on.
        every = np.arange(len(self.prior))
        each = [every[part].reshape(self.views, -1) for part in (self.pose_part, self._warped)]
        known_by_all = np.tile(every[self.calibration_part], (self.views, 1))
        self.columns = np.hstack([each[0], known_by_all, each[1]])
        self.groups = self._groups()

    def _groups(self) -> list[Group]:
        """Tie points between two views by these views, then all other landmarks."""
        begins = np.searchsorted(self.landmark, np.arange(self.count))
        ends = np.append(begins[1:], len(self.landmark))
        pair = self.view[begins] * self.views + self.view[ends - 1]
        pair[self.on_wall | (ends - begins != 2)] = -1
        groups = []
        for which in np.unique(pair):
            landmarks = np.flatnonzero(pair == which)
            rows = np.flatnonzero((pair == which)[self.landmark])
            columns = np.arange(len(self.prior))
            if which >= 0:
                columns = np.unique(self.columns[self.view[rows[:2]]])
            groups.append(
                Group(
                    landmarks,
                    columns,
                    rows,
                    np.searchsorted(landmarks, self.landmark[rows]),
                    np.searchsorted(columns, self.columns[self.view[rows]]),
                )
            )
        return groups

    def off_wall(self, points: FloatArray) -> FloatArray:
        """Distance of points (n, 3) from their walls, positive in front, m."""
        return np.asarray(np.sum(points * self.normal, 1) - self._level)

    def poses(self, shared: FloatArray) -> FloatArray:
        """Poses (views, 4) among the shared unknowns."""
        return np.asarray(shared[self.pose_part].reshape(self.views, _POSE))

    def linearize(self, points: FloatArray, shared: FloatArray) -> Linearized:
        """Residuals and derivatives at landmarks (n, 3) and shared unknowns (m,)."""
        poses = self.poses(shared)[self.view]
        d = points[self.landmark] - poses[:, :3]
        reach = np.maximum(np.hypot(d[:, 0], d[:, 1]), _NEAREST_M)
        seen = self._seen - np.stack(
            [np.arctan2(d[:, 1], d[:, 0]) - poses[:, 3], d[:, 2] / reach], 1
        )
        seen[:, 0] = wrap_rad(seen[:, 0])
        by_point = np.zeros((len(d), 2, 3))
        by_point[:, 0, 0] = -d[:, 1] / reach**2
        by_point[:, 0, 1] = d[:, 0] / reach**2
        by_point[:, 1, :2] = -(d[:, 2] / reach**3)[:, None] * d[:, :2]
        by_point[:, 1, 2] = 1.0 / reach
        rest = [np.tile([[-1.0], [0.0]], (len(d), 1, 1))]
        if len(self._calibration):
            errors, by_errors = shared[self.calibration_part], self._by_errors(reach)
            rest.append(by_errors)
            seen += self._corrected - by_errors @ errors
            by_offset = by_errors[..., _OFFSET] @ errors[_OFFSET]
            by_point[..., :2] -= by_offset[..., None] * (d[:, :2] / reach[:, None] ** 2)[:, None]
        if len(self._warps):
            rest.append(self._by_warps)
            own = shared[self._warped].reshape(self.views, -1)[self.view]
            seen -= (self._by_warps @ own[..., None])[..., 0]
        wall = self._wall_design @ shared[self._walls] - self.off_wall(points)
        by_view = np.concatenate([-by_point, *rest], -1)
        return Linearized(points, shared, seen, wall, by_point, by_view)

    def _by_errors(self, reach: FloatArray) -> FloatArray:
        """Derivatives (k, 2, c) of azimuths and tangents by errors of the calibration."""
        tangent = self._seen[:, 1]
        square = 1.0 + tangent**2
        out = np.zeros((len(reach), 2, len(CALIBRATED)))
        cos, sin = np.cos(self._seen[:, 0]), np.sin(self._seen[:, 0])
        # A camera in front of the axis is nearer; one to its left sees objects more to the right;
        # a leaning axis lifts it.
        ahead, left = self._rises @ [cos, sin], self._rises @ [-sin, cos]
        out[:, 1, 0], out[:, 0, 1] = (tangent - ahead) / reach, -1.0 / reach
        out[:, 1, 1] = -left / reach
        out[:, 1, 2], out[:, 1, 3] = -square, tangent
        out[:, :, 4:] = self._by_turns @ self._tilt_axes
        return out

    @cached_property
    def _by_warps(self) -> FloatArray:
        """Derivatives (k, 2, w) of azimuths and tangents by tilt and waves of their panorama."""
        phase = self._seen[:, :1] * np.arange(1, _WAVES + 1)
        waves = np.zeros((len(phase), 2, 2 * _WAVES))
        waves[:, 0] = np.hstack([np.cos(phase), np.sin(phase)])
        return np.concatenate([self._by_turns, waves], -1)[..., self._warps]

    @cached_property
    def _by_turns(self) -> FloatArray:
        """Derivatives (k, 2, 2) of azimuths and tangents by turns about x and y of the base."""
        azimuth, tangent = self._seen.T
        cos, sin, square = np.cos(azimuth), np.sin(azimuth), 1.0 + tangent**2
        by_azimuth = np.stack([tangent * cos, tangent * sin], 1)
        return np.stack([by_azimuth, np.stack([-sin, cos], 1) * square[:, None]], 1)

    def normal_equations(self, at: Linearized, weights: Weights) -> NormalEquations:
        """Normal equations at a point of linearization."""
        shared, (seen, wall, spread) = at.shared, weights
        prior = covariance_of(self.prior_covariance(spread))
        jx = at.by_point * seen[..., None]
        h_xx = _sum_by(self.landmark, jx.swapaxes(1, 2) @ at.by_point)
        h_xx += np.einsum('n,ni,nj->nij', wall, self.normal, self.normal)
        # Bearings alone may leave a landmark undetermined along its ray.
        h_xx += (_WEAK * wall)[:, None, None] * np.eye(3)
        b_x = _sum_by(self.landmark, np.einsum('nki,nk->ni', jx, at.seen))
        b_x += (wall * at.wall)[:, None] * self.normal
        h_ss, parts = prior, []
        b_s = prior @ (self.prior - shared)
        weighted_design = wall[:, None] * self._wall_design
        for group in self.groups:
            by_shared = group.by_columns(at)
            h_xs = _sum_by(group.local, jx[group.rows].swapaxes(1, 2) @ by_shared)
            flat = by_shared.reshape(-1, len(group.columns))
            weighted = flat * seen[group.rows].reshape(-1, 1)
            h_ss[np.ix_(group.columns, group.columns)] += weighted.T @ flat
            b_s[group.columns] += weighted.T @ at.seen[group.rows].ravel()
            if len(group.columns) == len(shared):
                design = weighted_design[group.landmarks, None]
                h_xs[..., self._walls] -= self.normal[group.landmarks, :, None] * design
            parts.append(h_xs)
        h_ss[self._walls, self._walls] += weighted_design.T @ self._wall_design
        b_s[self._walls] -= weighted_design.T @ at.wall
        return NormalEquations(self.groups, h_xx, parts, h_ss, b_x, b_s)

    def cost(self, at: Linearized, weights: Weights) -> float:
        """Twice the function whose derivative `normal_equations` has; the same arguments."""
        seen, wall, spread = weights
        off = at.shared - self.prior
        reduction = off @ solve_positive(self.prior_covariance(spread), off)
        return float(np.sum(seen * at.seen**2) + np.sum(wall * at.wall**2) + reduction)

    def prior_covariance(self, spread: FloatArray) -> FloatArray:
        """Prior covariance (m, m) of the shared unknowns by the `spread` of weights."""
        plan, height, *hanging = spread
        factor = np.where(self._height, height, plan)
        off_walls = sum(s**2 * part for s, part in zip(hanging, self._wall_patterns, strict=True))
        covariance = np.zeros((len(self.prior), len(self.prior)))
        for part, block in (
            (self.pose_part, self._places * np.outer(factor, factor)),
            (self._walls, off_walls + self._given_wall_covariance),
            (self.calibration_part, self._calibration),
            (self._warped, self._warp_variance),
        ):
            covariance[part, part] = block
        return covariance

    def spread_misfit(
        self, shared: FloatArray, equations: NormalEquations, spread: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Squared misfit (5,) and redundancy (5,) of each of `spread` by restricted likelihood."""
        prior = self.prior_covariance(spread)
        information = covariance_of(prior)
        misfit = information @ (shared - self.prior)
        left = information @ (prior - equations.shared_covariance) @ information
        # The prior is the sum of one part for each of `spread`.
        lifted = np.zeros(len(prior))
        lifted[self.pose_part] = self._height
        upward = 0.5 * (lifted[:, None] + lifted)
        places = np.zeros(prior.shape)
        places[self.pose_part, self.pose_part] = prior[self.pose_part, self.pose_part]
        parts = [(1.0 - upward) * places, upward * places]
        for sigma, pattern in zip(spread[2:], self._wall_patterns, strict=True):
            parts.append(np.zeros(prior.shape))
            parts[-1][self._walls, self._walls] = sigma**2 * pattern
        squares = np.array([misfit @ part @ misfit for part in parts])
        counts = np.array([np.sum(part * left) for part in parts])
        return np.maximum(squares, 0.0), np.maximum(counts, 0.0)

    def predicted_variance(
        self, at: Linearized, equations: NormalEquations
    ) -> tuple[FloatArray, FloatArray]:
        """Variance of what the solution says of each measurement (k, 2) and each wall (n,)."""
        own, shared = equations.own_covariance, equations.shared_covariance
        by_own = at.by_point @ own[self.landmark]
        seen = np.sum(by_own * at.by_point, -1)
        wall = np.einsum('ni,nij,nj->n', self.normal, own, self.normal)
        for group, gain in zip(self.groups, equations.gain, strict=True):
            block = shared[np.ix_(group.columns, group.columns)]
            by_shared = group.by_columns(at) - at.by_point[group.rows] @ gain[group.local]
            seen[group.rows] += np.sum((by_shared @ block) * by_shared, -1)
            by_wall = -np.einsum('ni,nip->np', self.normal[group.landmarks], gain)
            if len(group.columns) == len(shared):
                by_wall[:, self._walls] -= self._wall_design[group.landmarks]
            wall[group.landmarks] += np.sum((by_wall @ block) * by_wall, -1)
        return seen, wall


def wall_sections(
    points: FloatArray, walls: Sequence[int], room: Room, length_m: float
) -> IndexArray:
    """
    Numbers (n,) of the sections of wall that points (n, 3) hang on.

    What is near each other is mostly part of one thing, and hangs equally far from the wall:
    twenty patches of an image say no more of how objects hang than one does.
    """
    start = np.array([room.walls[w].start for w in walls])
    side = np.array([wall.along for wall in room.walls])[list(walls)]
    along = np.sum((points[:, :2] - start) * side, 1)
    cells = np.stack([np.asarray(walls), np.floor(along / length_m)], 1)
    cells[cells[:, 0] < 0] = -1
    return np.asarray(np.unique(cells, axis=0, return_inverse=True)[1], np.intp).ravel()


def _sum_by(index: IndexArray, values: FloatArray) -> FloatArray:
    """Sum values (k, ...) of equal index (k,), ascending and without gaps, into rows."""
    starts = np.flatnonzero(np.diff(index, prepend=-1))
    if 2 * len(starts) == len(index) and (starts[1:] - starts[:-1] == 2).all():
        return np.asarray(values[::2] + values[1::2])  # much faster
    return np.asarray(np.add.reduceat(values, starts))


def _calibration(
    panoramas: Sequence[Panorama],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Tilt axes (2, 2), rises (2,), prior of `CALIBRATED` or none, values panoramas have."""
    known, made_with = panoramas[-1].calibration, [p.made_with for p in panoramas]
    if known is None or any(values is None for values in made_with):
        return np.eye(2), np.zeros(2), np.zeros(0), np.zeros((0, 0)), np.zeros((len(panoramas), 0))
    # The lens of another camera says nothing of this one.
    other = [p.calibration is not None and not p.calibration.same_camera(known) for p in panoramas]
    lens = np.logical_and.outer(other, np.isin(NAMES, LENS))
    made = np.where(lens, known.values, np.array(made_with, np.float64))
    which = [NAMES.index(name) for name in CALIBRATED]
    covariance = known.covariance[np.ix_(which, which)] + _LEAST_ERROR**2 * np.eye(len(which))
    # Rises of a camera that is moved along x and y of the base about the pan axis.
    normal = rotation_rpy(known.mount.axis_rpy)[:, 2]
    rises = -normal[:2] / normal[2]
    return tilt_axes(known), rises, known.values[which], covariance, made[:, which]
