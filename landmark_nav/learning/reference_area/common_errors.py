"""
What places of sweeps err in common, as all of them are measured from the same papers.

First order, without an image: the measurements are the four edges of each paper, as in `fit`;
what is not exactly known there (height, tilt, how large papers are, how each hangs) is not known
here either.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag, eigh, solve_triangular

from landmark_nav.geometry.walls import Room
from landmark_nav.learning.least_squares import covariance_of, root_of
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.learning.reference_area.search import LEAST_PAPERS, papers_in_view
from landmark_nav.types import FloatArray, Panorama

# Of an edge, beside what its points share: some tens of profiles, by frame and along it.
_PROFILES_PX = 0.03

# x, y, heading, height, two tilts, size of papers; then two of each paper.
_SIZE, _PAPERS = 6, 7

# Share of the variance in height that sweeps have in common; the most of any other.
_COMMON, _MOST = 0.9, 0.99

_X_Y_HEADING = np.array([0, 1, 3])
_PLAN = np.ix_(_X_Y_HEADING, _X_Y_HEADING)


def pose_errors(
    eye: FloatArray,
    room: Room,
    config: ReferenceAreaConfig,
    focal_px: float,
    seen: npt.NDArray[np.bool_] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """
    How well papers give x, y and heading of viewpoints, and what these errors are made of.

    Parameters
    ----------
    eye : ndarray, shape (p, 3)
        Viewpoints, metres.
    config : ReferenceAreaConfig
        How exactly they and the camera are known.
    seen : ndarray of bool, shape (p, k), optional
        Which papers are seen: all without it. It takes three.

    Returns
    -------
    covariance : ndarray, shape (p, 3, 3)
        Of x, y, heading.
    by_papers : ndarray, shape (p, 3, 1 + 2 k)
        How the part of it comes about that is one and the same from everywhere, by factors of
        unit variance: size of the papers, and how far each hangs off along its wall and up.
    """
    center, along, size = _papers(room)
    papers = len(center)
    jacobian = np.zeros((len(eye), papers, 4, _PAPERS + 2 * papers))
    for edge, (right, up) in enumerate(((-0.5, 0), (0.5, 0), (0, -0.5), (0, 0.5))):
        off = np.column_stack([right * size[:, :1] * along, up * size[:, 1]])
        d = center + off - eye[:, None]
        reach_sq = np.sum(d[..., :2] ** 2, -1)
        reach = np.sqrt(reach_sq)
        row = jacobian[:, :, edge]
        by_point = np.zeros_like(d)
        if right:
            by_point[..., :2] = np.stack([-d[..., 1], d[..., 0]], -1) / reach_sq[..., None]
            row[..., 2] = -1.0
        else:
            by_point[..., :2] = -(d[..., 2] / reach**3)[..., None] * d[..., :2]
            by_point[..., 2] = 1.0 / reach
            row[..., 4:6] = d[..., :2] / reach[..., None]
        row[..., [0, 1, 3]] = -by_point
        row[..., _SIZE] = np.sum(by_point * off, -1)
        each = np.arange(papers)
        row[:, each, _PAPERS + 2 * each] = np.sum(by_point[..., :2] * along, -1)
        row[:, each, _PAPERS + 1 + 2 * each] = by_point[..., 2]
    if seen is not None:
        jacobian *= seen[:, :, None, None]
    sigma = np.hypot(_PROFILES_PX, config.edge_sigma_px) / focal_px
    rows = jacobian.reshape(len(eye), 4 * papers, _PAPERS + 2 * papers) / sigma
    given = [config.height_sigma_m, *[config.horizon_sigma_rad] * 2, config.paper_size_sigma]
    given += [max(config.paper_sigma_m, 1e-6)] * (2 * papers)
    prior = np.array([np.inf] * 3 + given)
    information = np.swapaxes(rows, -1, -2) @ rows + np.diag(prior**-2.0)
    covariance = np.linalg.inv(information)
    # An estimate errs by its gain times what the prior did not know.
    by_papers = covariance[:, :3, _SIZE:] / prior[_SIZE:]
    return np.asarray(covariance[:, :3, :3]), np.asarray(by_papers)


def joint_covariance(
    panoramas: Sequence[Panorama], room: Room, config: ReferenceAreaConfig
) -> FloatArray:
    """
    Joint covariance of the places of sweeps that were each found for itself.

    A paper that hangs elsewhere than given moves all of them, and the camera stands equally high
    everywhere: as much of the error in height as can be is one and the same.

    Parameters
    ----------
    panoramas : sequence of Panorama
        With covariances of their own, v of them.
    room : Room
        Walls and papers; without papers places have nothing but their height in common.

    Returns
    -------
    ndarray, shape (4 v, 4 v)
        Of x, y, z, heading of each.
    """
    alone = [p.covariance + 1e-12 * np.eye(4) for p in panoramas]
    loading = [
        _loading(panorama, covariance, room, config)
        for panorama, covariance in zip(panoramas, alone, strict=True)
    ]
    rest = [c - part @ part.T for c, part in zip(alone, loading, strict=True)]
    height = _COMMON * min(1.0 / covariance_of(c)[2, 2] for c in rest)
    up = np.sqrt(height) * np.array([[0.0], [0.0], [1.0], [0.0]])
    return joined(np.stack(alone), np.stack([np.hstack([part, up]) for part in loading]))


def joined(alone: FloatArray, loading: FloatArray) -> FloatArray:
    """
    Joint covariance (v d, v d) of v vectors that have covariances (v, d, d) by themselves.

    Factors of unit variance that move all of them, by `loading` (v, d, m), are a part of these.
    """
    shared = loading.reshape(-1, loading.shape[-1])
    apart = 1.0 - block_diag(*np.ones_like(alone))
    return np.asarray(block_diag(*alone) + apart * (shared @ shared.T))


def _loading(
    panorama: Panorama, covariance: FloatArray, room: Room, config: ReferenceAreaConfig
) -> FloatArray:
    """How factors that sweeps have in common move one: its mount (c), papers (1 + 2 k)."""
    mounted = np.zeros((4, 0))
    if panorama.by_calibration is not None and panorama.calibration is not None:
        known = panorama.calibration
        mounted = panorama.by_calibration @ root_of(known.covariance)
    loading = np.hstack([mounted, _by_papers(panorama, covariance, room, config)])
    half = solve_triangular(root_of(covariance), loading, lower=True)
    share = float(np.linalg.norm(half, 2) ** 2)
    return np.asarray(loading * np.sqrt(_MOST / max(share, _MOST)))


def _by_papers(
    panorama: Panorama, covariance: FloatArray, room: Room, config: ReferenceAreaConfig
) -> FloatArray:
    """How papers that hang elsewhere move a panorama, (4, 1 + 2 k)."""
    loading = np.zeros((4, 1 + 2 * len(room.papers)))
    if len(room.papers) < LEAST_PAPERS:
        return loading
    eye = panorama.center_map[None]
    seen = papers_in_view(eye[:, :2], room)
    if seen.sum() >= LEAST_PAPERS:
        given, by_papers = pose_errors(eye, room, config, panorama.cylinder.fy, seen)
        # A pose that is better known than papers would give it comes from something else.
        ratio = eigh(covariance[_PLAN], given[0], eigvals_only=True)[-1]
        loading[_X_Y_HEADING] = min(1.0, ratio) * by_papers[0]
    return loading


def _papers(room: Room) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres (k, 3), directions along their walls (k, 2), sizes (k, 2)."""
    center = np.array([paper.center for paper in room.papers]).reshape(-1, 3)
    normal = room.normals[room.nearest_wall(center[:, :2]), :2]
    along = np.column_stack([normal[:, 1], -normal[:, 0]])
    return center, along, np.array([(p.width, p.height) for p in room.papers]).reshape(-1, 2)
