"""
How well the reference papers would tell where a sweep was taken: first order, without a picture.

The measurements are the four edges of each paper, as in `learning.reference_area`; what is not
exactly known there (height, tilt, how each paper hangs) is not known here either.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.walls import Room
from landmark_nav.planning.config import PlanConfig
from landmark_nav.types import FloatArray

__all__ = ['papers_seen', 'pose_covariance']

# Of an edge, beside what its points share: some tens of profiles, by frame and along it.
_PROFILES_PX = 0.03

# x, y, heading, height and two tilts.
_COMMON = 6

# Less than that of a paper is hardly found by its colour, pixels across and along.
_LEAST_PX = 8.0
_MOST_INCIDENCE_RAD = 1.2


def papers_seen(eye: FloatArray, room: Room, config: PlanConfig) -> npt.NDArray[np.bool_]:
    """
    Whether panoramas show a paper well enough to be measured.

    Parameters
    ----------
    eye : ndarray, shape (p, 3)
        Viewpoints.
    room : Room
        Walls and papers.
    config : PlanConfig
        The camera.

    Returns
    -------
    ndarray of bool, shape (p, papers)

    """
    center, _, size = _papers(room)
    normal = room.normals[room.nearest_wall(center[:, :2]), :2]
    way = eye[:, None, :2] - center[:, :2]
    reach = np.maximum(np.linalg.norm(way, axis=-1), 1e-6)
    cosine = np.sum(way * normal, -1) / reach
    half = 0.5 * size[:, 1]
    rise = np.abs(center[:, 2] - eye[:, None, 2]) + half
    across = size[:, 0] * cosine * config.focal_px / reach
    along = size[:, 1] * config.focal_px / reach
    return np.asarray(
        (cosine > np.cos(_MOST_INCIDENCE_RAD))
        & (rise < config.steepest * reach)
        & (np.minimum(across, along) >= _LEAST_PX)
        & room.visible(eye[:, None, :2], center[:, :2])
    )


def pose_covariance(
    eye: FloatArray, room: Room, config: PlanConfig, seen: npt.NDArray[np.bool_] | None = None
) -> FloatArray:
    """
    Covariance (p, 3, 3) of x, y, heading of viewpoints (p, 3) that see papers.

    Unknown are x, y, heading, height, two tilts of the axis, and each paper's offsets along the
    wall and up. `seen` (p, papers) says which are seen: all without it; it takes three.
    """
    center, along, size = _papers(room)
    papers = len(center)
    area = config.reference_area
    jacobian = np.zeros((len(eye), papers, 4, _COMMON + 2 * papers))
    for edge, (right, up) in enumerate(((-0.5, 0), (0.5, 0), (0, -0.5), (0, 0.5))):
        point = center + np.column_stack([right * size[:, :1] * along, up * size[:, 1]])
        d = point - eye[:, None]
        reach_sq = np.sum(d[..., :2] ** 2, -1)
        reach = np.sqrt(reach_sq)
        row = jacobian[:, :, edge]
        if right:
            by_point = np.stack([-d[..., 1], d[..., 0]], -1) / reach_sq[..., None]
            row[..., 2] = -1.0
        else:
            by_point = -(d[..., 2] / reach**3)[..., None] * d[..., :2]
            row[..., 3] = -1.0 / reach
            row[..., 4:6] = d[..., :2] / reach[..., None]
        row[..., :2] = -by_point
        each = np.arange(papers)
        row[:, each, _COMMON + 2 * each] = np.sum(by_point * along, -1)
        row[:, each, _COMMON + 1 + 2 * each] = 0.0 if right else 1.0 / reach
    sigma = np.hypot(_PROFILES_PX, area.edge_sigma_px) / config.focal_px
    if seen is not None:
        jacobian *= seen[:, :, None, None]
    rows = jacobian.reshape(len(eye), 4 * papers, _COMMON + 2 * papers) / sigma
    hanging = [max(area.paper_sigma_m, 1e-6)] * (2 * papers)
    tilts = [area.horizon_sigma_rad] * 2
    prior = np.array([np.inf] * 3 + [area.height_sigma_m, *tilts, *hanging])
    information = np.swapaxes(rows, -1, -2) @ rows + np.diag(prior**-2.0)
    return np.asarray(np.linalg.inv(information)[:, :3, :3])


def _papers(room: Room) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres (k, 3), directions along their walls (k, 2), sizes (k, 2)."""
    center = np.array([paper.center for paper in room.papers]).reshape(-1, 3)
    normal = room.normals[room.nearest_wall(center[:, :2]), :2]
    along = np.column_stack([normal[:, 1], -normal[:, 0]])
    return center, along, np.array([(p.width, p.height) for p in room.papers]).reshape(-1, 2)
