"""
Joint least squares of landmarks and panorama poses: a small bundle adjustment.

What landmarks share (the pose errors of the panoramas) is kept apart from what each has alone,
so that the map can say both (Triggs et al., Bundle Adjustment, 2000, for the Schur complement).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.stereo import Sighting
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import FloatArray, Panorama

__all__ = ['Adjustment', 'AdjustmentConfig', 'adjust']

# x, y, z, heading of each panorama; after all panoramas, how far things hang off the walls.
_POSE = 4


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

    `positions` (n, 3); `own_covariance` (n, 3, 3) what each landmark's error has alone;
    `shared_loading` (n, 3, m) the rest, as unit-variance factors; `panoramas` with new poses;
    `off_wall_m` (n,) distance from the wall and `chi_square` (n,) the misfit of each, over
    `degrees` (n,) redundant measurements.
    """

    positions: FloatArray
    own_covariance: FloatArray
    shared_loading: FloatArray
    poses: FloatArray
    pose_covariance: FloatArray
    off_wall_m: FloatArray
    chi_square: FloatArray
    degrees: FloatArray


def adjust(
    sightings: Sequence[Sequence[Sighting]],
    walls: Sequence[int],
    start: FloatArray,
    panoramas: Sequence[Panorama],
    room: Room,
    config: AdjustmentConfig,
    iterations: int = 12,
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
    iterations : int
        Gauss-Newton steps, robustly weighted after the second.

    Returns
    -------
    Adjustment

    """
    landmark = np.array([k for k, group in enumerate(sightings) for _ in group])
    view = np.array([s.panorama for group in sightings for s in group])
    seen = np.array([(s.azimuth_rad, s.tangent) for group in sightings for s in group])
    sigma = np.array(
        [
            (
                np.hypot(s.sigma_azimuth_rad, config.azimuth_sigma_rad),
                np.hypot(s.sigma_tangent, config.tangent_sigma),
            )
            for group in sightings
            for s in group
        ]
    )
    normal = room.normals[np.asarray(walls, dtype=int)]
    wall_start = np.array([(*room.walls[w].start, 0.0) for w in walls])
    level = np.sum(normal * wall_start, 1)

    count, views = len(start), len(panoramas)
    size = _POSE * views + 1
    prior_pose = np.array([(*p.center_map, p.heading_rad) for p in panoramas])
    prior_information = np.zeros((size, size))
    for i, panorama in enumerate(panoramas):
        part = slice(_POSE * i, _POSE * (i + 1))
        prior_information[part, part] = np.linalg.inv(panorama.covariance + 1e-12 * np.eye(4))
    prior_information[-1, -1] = config.common_hanging_sigma_m**-2

    points, poses, hanging = start.copy(), prior_pose.copy(), 0.0
    weight = np.ones(count)
    for step in range(iterations):
        predicted, by_point, by_pose = _model(points[landmark], poses[view])
        residual = seen - predicted
        residual[:, 0] = wrap_rad(residual[:, 0])
        off_wall = np.sum(points * normal, 1) - level
        wall_residual = (hanging - off_wall) / config.hanging_sigma_m
        misfit = np.sum((residual / sigma) ** 2, 1)
        chi_square = np.bincount(landmark, misfit, count) + wall_residual**2
        if step >= 2:
            # Cauchy weight: a false match bends neither its neighbours nor the poses.
            weight = 1.0 / (1.0 + chi_square / 9.0)

        scale = np.sqrt(weight[landmark])[:, None] / sigma
        jx = by_point * scale[..., None]
        jp = by_pose * scale[..., None]
        r = residual * scale
        wall_scale = weight / config.hanging_sigma_m**2
        h_xx = np.einsum('n,ni,nj->nij', wall_scale, normal, normal)
        np.add.at(h_xx, landmark, np.einsum('nki,nkj->nij', jx, jx))
        b_x = (wall_scale * (hanging - off_wall))[:, None] * normal
        np.add.at(b_x, landmark, np.einsum('nki,nk->ni', jx, r))
        h_xp = np.zeros((count, 3, views, _POSE))
        np.add.at(h_xp, (landmark, slice(None), view), np.einsum('nki,nkj->nij', jx, jp))
        h_xp = h_xp.reshape(count, 3, size - 1)
        h_xp = np.concatenate([h_xp, -(wall_scale[:, None] * normal)[..., None]], 2)
        h_pp = prior_information.copy()
        b_p = np.zeros(size)
        delta = (prior_pose - poses).ravel()
        b_p[:-1] += prior_information[:-1, :-1] @ delta
        b_p[-1] -= prior_information[-1, -1] * hanging
        pose_blocks = np.zeros((views, _POSE, _POSE))
        np.add.at(pose_blocks, view, np.einsum('nki,nkj->nij', jp, jp))
        pose_rhs = np.zeros((views, _POSE))
        np.add.at(pose_rhs, view, np.einsum('nki,nk->ni', jp, r))
        for i in range(views):
            part = slice(_POSE * i, _POSE * (i + 1))
            h_pp[part, part] += pose_blocks[i]
        b_p[:-1] += pose_rhs.ravel()
        h_pp[-1, -1] += wall_scale.sum()
        b_p[-1] -= np.sum(wall_scale * (hanging - off_wall))

        own = np.linalg.inv(h_xx)
        gain = np.einsum('nij,njp->nip', own, h_xp)
        schur = h_pp - np.einsum('nip,niq->pq', h_xp, gain)
        move = np.linalg.solve(schur, b_p - np.einsum('nip,ni->p', gain, b_x))
        poses = poses + move[:-1].reshape(views, _POSE)
        hanging += float(move[-1])
        points = points + np.einsum('nij,nj->ni', own, b_x) - gain @ move
        if step > 3 and np.abs(move).max() < 1e-7:
            break
    shared = np.linalg.inv(schur)
    loading = -gain @ np.linalg.cholesky(shared)
    seen_from = np.bincount(landmark, minlength=count)
    # A down-weighted landmark was not trusted: undo the weight in what it claims for itself.
    return Adjustment(
        points,
        own,
        loading,
        poses,
        shared[:-1, :-1].reshape(views, _POSE, views, _POSE)[
            np.arange(views), :, np.arange(views), :
        ],
        off_wall,
        chi_square,
        2.0 * seen_from + 1.0 - 3.0,
    )


def _model(points: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Azimuth and tangent (m, 2), with derivatives by point (m, 2, 3) and pose (m, 2, 4)."""
    d = points - poses[:, :3]
    reach = np.hypot(d[:, 0], d[:, 1])
    predicted = np.stack([np.arctan2(d[:, 1], d[:, 0]) - poses[:, 3], d[:, 2] / reach], 1)
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0] = -d[:, 1] / reach**2
    by_point[:, 0, 1] = d[:, 0] / reach**2
    by_point[:, 1, 0] = -d[:, 2] * d[:, 0] / reach**3
    by_point[:, 1, 1] = -d[:, 2] * d[:, 1] / reach**3
    by_point[:, 1, 2] = 1.0 / reach
    by_pose = np.concatenate([-by_point, np.zeros((len(points), 2, 1))], 2)
    by_pose[:, 0, 3] = -1.0
    return predicted, by_point, by_pose
