"""The least-squares problem of the smoother: unknowns, whitened residuals, their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

from landmark_nav.arrays import IndexArray
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import relative, rotation
from landmark_nav.localization.fusion.lens import straightened
from landmark_nav.localization.smoother.motion import Motions
from landmark_nav.types import Detections, FloatArray, LandmarkMap, PoseEstimate

__all__ = ['Bearings', 'Problem']


# Unknowns of each time: x, y, heading, and the error of the pan in its own sigmas.
_PER_POSE = 4
_PAN = 3
# Unknowns of all times: the four systematic errors of the odometry, boresight, principal point.
_COMMON = 6
_BORESIGHT, _LENS = 4, 5
# What is taken as known exactly would be singular: a micrometre, a microradian.
_LEAST_SIGMA = 1e-6


@dataclass(frozen=True, eq=False)
class Bearings:
    """
    All bearings (m,): of which pose, to which landmark, what and how sure, with which pan.

    `before` (m,) is the bearing of the same landmark before, -1 for the first.
    """

    pose: IndexArray
    landmark: IndexArray
    bearing_rad: FloatArray
    sigma_rad: FloatArray
    pan_rad: FloatArray
    before: IndexArray

    @classmethod
    def of(cls, sightings: Sequence[Detections], landmark_map: LandmarkMap) -> Bearings:
        """Take what the map holds; pose 0 is the start, pose k + 1 that of detection k."""
        known = [np.isin(seen.ids, landmark_map.ids) for seen in sightings]
        kept = [seen.chosen(which) for seen, which in zip(sightings, known, strict=True)]
        counts = [len(seen) for seen in kept]
        landmark = landmark_map.indices(np.concatenate([seen.ids for seen in kept]))
        return cls(
            np.repeat(np.arange(1, len(kept) + 1), counts),
            landmark,
            np.concatenate([seen.bearing_rad for seen in kept]),
            np.sqrt(np.concatenate([seen.variance_rad2 for seen in kept])),
            np.repeat([seen.pan_rad for seen in kept], counts),
            _same_before(landmark),
        )


def _same_before(values: IndexArray) -> IndexArray:
    """Where each value stood before, -1 where it is the first of its kind, (m,)."""
    order = np.argsort(values, kind='stable')
    before = np.full(len(values), -1)
    same = values[order[1:]] == values[order[:-1]]
    before[order[1:][same]] = order[:-1][same]
    return before


class _Rows:
    """A sparse Jacobian (rows, columns) that grows by dense blocks."""

    def __init__(self) -> None:
        self._rows: list[IndexArray] = []
        self._columns: list[IndexArray] = []
        self._values: list[FloatArray] = []
        self._residuals: list[FloatArray] = []
        self._count = 0

    def add(self, residual: FloatArray, *parts: tuple[IndexArray, FloatArray]) -> None:
        """Append residuals (m, r), with derivatives (m, r, c) by columns (m, c)."""
        rows = self._count + np.arange(residual.size).reshape(residual.shape)
        for columns, values in parts:
            self._rows.append(np.broadcast_to(rows[:, :, None], values.shape).ravel())
            self._columns.append(np.broadcast_to(columns[:, None, :], values.shape).ravel())
            self._values.append(values.ravel())
        self._residuals.append(residual.ravel())
        self._count += residual.size

    def matrix(self, columns: int) -> tuple[csr_matrix, FloatArray]:
        """Return all that was added."""
        place = (np.concatenate(self._rows), np.concatenate(self._columns))
        values = np.concatenate(self._values)
        jacobian = coo_matrix((values, place), shape=(self._count, columns)).tocsr()
        return jacobian, np.concatenate(self._residuals)


@dataclass(frozen=True, eq=False)
class Problem:
    """
    What is known: start, odometry, bearings, map, and how well.

    `common_sigmas` (6,) are those of the odometry's scale, drift, turn scale and way lost in
    turns, of the boresight and of the principal point; `lever` (2,) is the pan axis in the base.
    Detections of a landmark repeat `correlated_noise_fraction` of their variance over
    `repeat_length_m` of way; what each repeats is unknown, too.
    """

    start: PoseEstimate
    motions: Motions
    bearings: Bearings
    landmark_map: LandmarkMap
    lever: FloatArray
    common_sigmas: FloatArray
    pan_sigma: float
    correlated_noise_fraction: float
    repeat_length_m: float
    robust_sigmas: float

    @property
    def pose_columns(self) -> IndexArray:
        """Where x, y and heading of each time are among the unknowns, (n, 3)."""
        first = _PER_POSE * np.arange(len(self.motions.increment) + 1)
        return np.asarray(first[:, None] + np.arange(3))

    @property
    def _common(self) -> int:
        return _PER_POSE * (len(self.motions.increment) + 1)

    @property
    def _repeated(self) -> int:
        return self._common + _COMMON + 2 * len(self.landmark_map.landmarks)

    def at(self, poses: FloatArray) -> FloatArray:
        """Unknowns at poses (n, 3), all errors zero."""
        per_pose = np.column_stack([poses, np.zeros(len(poses))])
        surveyed = self.landmark_map.positions[:, :2]
        nothing = np.zeros(len(self.bearings.pose))
        return np.concatenate([per_pose.ravel(), np.zeros(_COMMON), surveyed.ravel(), nothing])

    def poses(self, unknowns: FloatArray) -> FloatArray:
        """Poses (n, 3)."""
        return np.asarray(unknowns[self.pose_columns])

    def landmarks(self, unknowns: FloatArray) -> FloatArray:
        """Places of the landmarks (l, 2)."""
        return unknowns[self._common + _COMMON : self._repeated].reshape(-1, 2)

    def camera(self, unknowns: FloatArray) -> tuple[float, float]:
        """Boresight: constant offset of all bearings, radians; principal point, see `lens`."""
        boresight, lens = unknowns[self._common + np.array([_BORESIGHT, _LENS])].tolist()
        return boresight, lens

    def advanced(self, unknowns: FloatArray, step: FloatArray) -> tuple[FloatArray, float]:
        """Take a step of at most half a metre or radian; how far the poses moved."""
        moved = float(np.abs(self.poses(step)).max())
        after = unknowns + step * min(1.0, 0.5 / max(moved, 1e-12))
        headings = self.pose_columns[:, 2]
        after[headings] = wrap_rad(after[headings])
        return after, moved

    def linearized(self, unknowns: FloatArray) -> tuple[csr_matrix, FloatArray]:
        """Jacobian (rows, unknowns) and residuals (rows,), in sigmas."""
        rows = _Rows()
        self._add_priors(rows, unknowns)
        self._add_motions(rows, unknowns)
        self._add_repeated(rows, unknowns)
        self._add_bearings(rows, unknowns)
        return rows.matrix(len(unknowns))

    def _add_priors(self, rows: _Rows, unknowns: FloatArray) -> None:
        offset = self.poses(unknowns)[:1] - self.start.pose
        offset[:, 2] = wrap_rad(offset[:, 2])
        whiten = _whitening(self.start.covariance[None])
        rows.add(np.einsum('mij,mj->mi', whiten, offset), (self.pose_columns[:1], whiten))

        pans = self.pose_columns[:, :1] + _PAN
        rows.add(unknowns[pans], (pans, np.ones((len(pans), 1, 1))))

        common = self._common + np.arange(_COMMON)[:, None]
        weights = 1.0 / np.maximum(self.common_sigmas, _LEAST_SIGMA)[:, None]
        rows.add(weights * unknowns[common], (common, weights[:, :, None]))

        whiten = _whitening(self.landmark_map.joint_covariance_xy[None])
        moved = (self.landmarks(unknowns) - self.landmark_map.positions[:, :2]).reshape(1, -1)
        places = np.arange(self._common + _COMMON, self._repeated)[None]
        rows.add(np.einsum('mij,mj->mi', whiten, moved), (places, whiten))

    def _add_motions(self, rows: _Rows, unknowns: FloatArray) -> None:
        """Pose in the frame of the one before, minus what the corrected odometry says."""
        poses, columns = self.poses(unknowns), self.pose_columns
        moved = relative(poses[:-1], poses[1:])
        common = self._common + np.arange(_BORESIGHT)
        residual = moved - self.motions.increment - self.motions.by_bias @ unknowns[common]
        residual[:, 2] = wrap_rad(residual[:, 2])
        by_after = np.zeros((len(moved), 3, 3))
        by_after[:, :2, :2] = rotation(-poses[:-1, 2])
        by_after[:, 2, 2] = 1.0
        by_before = -by_after
        by_before[:, 0, 2], by_before[:, 1, 2] = moved[:, 1], -moved[:, 0]
        whiten = _whitening(self.motions.covariance)
        rows.add(
            np.einsum('mij,mj->mi', whiten, residual),
            (columns[:-1], whiten @ by_before),
            (columns[1:], whiten @ by_after),
            (np.tile(common, (len(moved), 1)), -whiten @ self.motions.by_bias),
        )

    def _add_repeated(self, rows: _Rows, unknowns: FloatArray) -> None:
        """What detections repeat, over its sigma: a Gauss-Markov process of the way."""
        seen = self.bearings
        way = np.cumsum([0.0, *np.hypot(*self.motions.increment[:, :2].T)])[seen.pose]
        again = seen.before >= 0
        kept = again * np.exp(-np.abs(way - way[seen.before]) / self.repeat_length_m)
        weight = 1.0 / np.sqrt(np.maximum(1.0 - kept**2, _LEAST_SIGMA**2))
        columns = self._repeated + np.column_stack([np.arange(len(way)), seen.before * again])
        by_both = weight[:, None] * np.column_stack([np.ones(len(way)), -kept])
        residual = np.sum(by_both * unknowns[columns], axis=1)
        rows.add(residual[:, None], (columns, by_both[:, None]))

    def _add_bearings(self, rows: _Rows, unknowns: FloatArray) -> None:
        """Measured minus expected bearings, the doubtful ones with less weight."""
        seen = self.bearings
        x, y, heading = self.poses(unknowns)[seen.pose].T
        cos, sin = np.cos(heading), np.sin(heading)
        arm_x = cos * self.lever[0] - sin * self.lever[1]
        arm_y = sin * self.lever[0] + cos * self.lever[1]
        places = self._common + _COMMON + 2 * seen.landmark[:, None] + np.arange(2)
        dx, dy = (unknowns[places] - np.stack([x + arm_x, y + arm_y], -1)).T
        pan = self.pose_columns[seen.pose, 0] + _PAN
        expected = np.arctan2(dy, dx) - heading
        boresight, lens = self.camera(unknowns)
        bearing, by_lens = straightened(seen.bearing_rad, seen.pan_rad, lens)
        repeated = self._repeated + np.arange(len(dx))
        by_repeated = np.sqrt(self.correlated_noise_fraction) * seen.sigma_rad
        sigma = np.maximum(
            np.sqrt(1.0 - self.correlated_noise_fraction) * seen.sigma_rad, _LEAST_SIGMA
        )
        offset = boresight + self.pan_sigma * unknowns[pan] + by_repeated * unknowns[repeated]
        residual = wrap_rad(bearing - offset - expected) / sigma
        # Cauchy's weight, as of where we are.
        weight = 1.0 / (sigma * np.hypot(1.0, residual / self.robust_sigmas))
        by_place = np.stack([dy, -dx], -1) / (dx * dx + dy * dy)[:, None]
        by_heading = 1.0 + by_place[:, 0] * arm_y - by_place[:, 1] * arm_x
        by_pose = np.column_stack([-by_place, by_heading, np.full(len(dx), -self.pan_sigma)])
        columns = np.column_stack([self.pose_columns[seen.pose], pan])
        camera = np.tile(self._common + np.array([_BORESIGHT, _LENS]), (len(dx), 1))
        by_camera = np.column_stack([-np.ones(len(dx)), by_lens])
        rows.add(
            (weight * sigma * residual)[:, None],
            (columns, (weight[:, None] * by_pose)[:, None]),
            (places, (weight[:, None] * by_place)[:, None]),
            (camera, (weight[:, None] * by_camera)[:, None]),
            (repeated[:, None], (-weight * by_repeated)[:, None, None]),
        )


def _whitening(covariance: FloatArray) -> FloatArray:
    """Matrices (..., k, k) that turn errors of covariances (..., k, k) into unit ones."""
    least = _LEAST_SIGMA**2 * np.eye(covariance.shape[-1])
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance + least)))
