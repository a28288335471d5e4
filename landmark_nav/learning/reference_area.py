"""
Where a sweep was taken, from coloured papers that hang at known places.

Blobs give hypotheses (each blob's height is its range, so that two papers and more fix a pose);
the edges of the papers, found to sub-pixel, then decide and refine. Livatino and Madsen
triangulate the three papers; all their edges together say the same more accurately, and their
heights tell wrong combinations from right ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from scipy.optimize import least_squares

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.walls import Paper, Room
from landmark_nav.learning.panorama import CylinderImage
from landmark_nav.learning.papers import find_blobs, locate_edges, opponent_image, PaperBlobs
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import FloatArray

__all__ = ['ReferenceAreaConfig', 'SweepPlace', 'locate_sweep']

_SAMPLES_PER_EDGE = 15
# Blobs of a colour that are tried, those of the most fitting height first.
_MAX_BLOBS = 14
_MAX_STARTS = 6


@dataclass(frozen=True)
class ReferenceAreaConfig:
    """What is not exactly known when a place is measured from the papers."""

    paper_sigma_m: float = parameter(
        0.001, 'standard deviation of how exactly a paper hangs, metres', minimum=0, maximum=0.1
    )
    height_sigma_m: float = parameter(
        0.005, "standard deviation of the camera's height, metres", minimum=1e-5, maximum=0.5
    )
    horizon_sigma_rad: float = parameter(
        0.003, 'standard deviation of the horizon, radians', minimum=1e-6, maximum=0.2
    )
    edge_sigma_px: float = parameter(
        0.1, 'standard deviation that all points of one edge share, pixels', minimum=0, maximum=2
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_parameters(self)


@dataclass(frozen=True, eq=False)
class SweepPlace:
    """
    Where a sweep was taken.

    `pose_map_base` (3,) and `height_m` of the optical centre, `covariance` (4, 4) of x, y, z,
    heading.
    """

    pose_map_base: FloatArray
    height_m: float
    covariance: FloatArray


def locate_sweep(
    view: CylinderImage, room: Room, mount: PanTiltMount, config: ReferenceAreaConfig
) -> SweepPlace:
    """
    Measure the place of a sweep from the reference papers.

    Parameters
    ----------
    view : CylinderImage
        The sweep as a cylinder in the base frame.
    room : Room
        Papers and walls in map.
    mount : PanTiltMount
        Pan axis in the base frame.
    config : ReferenceAreaConfig
        Prior standard deviations.

    Returns
    -------
    SweepPlace

    Raises
    ------
    LandmarkNavError
        Fewer than three papers in the room, papers not found, or more than one place fits.

    """
    if len(room.papers) < 3:
        raise LandmarkNavError(
            f'the room names {len(room.papers)} reference papers: hang three and list them in '
            'room.yaml, or give the pose of each sweep (sweep/pose)'
        )
    blobs = [_plausible(find_blobs(view, paper.color), paper, mount) for paper in room.papers]
    missing = [p.color for p, b in zip(room.papers, blobs, strict=True) if not len(b.azimuth_rad)]
    if missing:
        raise LandmarkNavError(
            f'reference papers not found: {", ".join(missing)} of '
            f'{", ".join(p.color for p in room.papers)}; see that they hang in view and in light'
        )
    fitter = _PaperFitter(view, room, mount, config)
    fits = [fitter.fit(start) for start in _hypotheses(blobs, room, mount)]
    good = sorted((f for f in fits if f is not None), key=lambda f: -f.support)
    if not good:
        raise LandmarkNavError(
            f'no place in the room fits the blobs found ({_counted(room.papers, blobs)}): '
            'check colours, sizes and places of the papers in room.yaml'
        )
    best = good[0]
    for other in good[1:]:
        away = se2.relative(best.place.pose_map_base, other.place.pose_map_base)
        distinct = np.hypot(away[0], away[1]) > 0.1 or abs(away[2]) > 0.05
        if distinct and other.support > 0.8 * best.support:
            raise LandmarkNavError(
                'the reference papers are ambiguous: '
                f'({_at(best)}) and ({_at(other)}) fit alike; hang them at unequal distances'
            )
    return best.place


@dataclass(frozen=True, eq=False)
class _Fit:
    place: SweepPlace
    support: float


def _reach(blobs: PaperBlobs, paper: Paper) -> FloatArray:
    """Horizontal distance at which a paper has the height of each blob, metres."""
    return np.asarray(paper.height / np.maximum(blobs.tangent[:, 0] - blobs.tangent[:, 1], 1e-6))


def _rise(blobs: PaperBlobs, paper: Paper, mount: PanTiltMount) -> FloatArray:
    """How much higher than the paper each blob would hang at its reach, in its uncertainty."""
    reach = _reach(blobs, paper)
    rise = mount.axis_xyz[2] + reach * blobs.tangent.mean(1) - paper.center[2]
    return np.asarray(rise / _blob_sigma(reach))


def _blob_sigma(reach: FloatArray) -> FloatArray:
    """Rough standard deviation of a blob's place, metres: its outline is a pixel or two off."""
    return 0.03 + 0.04 * reach


def _plausible(blobs: PaperBlobs, paper: Paper, mount: PanTiltMount) -> PaperBlobs:
    """Blobs that hang as high as the paper does, whatever their distance."""
    rise = np.abs(_rise(blobs, paper, mount))
    order = np.argsort(rise)[:_MAX_BLOBS]
    order = order[rise[order] < 5.0]
    return PaperBlobs(blobs.azimuth_rad[order], blobs.tangent[order])


def _hypotheses(blobs: list[PaperBlobs], room: Room, mount: PanTiltMount) -> list[FloatArray]:
    """Base poses (3,) that explain one blob a paper, the most consistent first."""
    paper_xyz = np.array([paper.center for paper in room.papers])
    pairs = list(zip(blobs, room.papers, strict=True))
    picks = np.array(list(product(*(range(len(b.azimuth_rad)) for b in blobs))))
    azimuth = np.stack([b.azimuth_rad[picks[:, k]] for k, b in enumerate(blobs)], 1)
    tangent = np.stack([b.tangent[picks[:, k]] for k, b in enumerate(blobs)], 1)
    reach = np.stack([_reach(b, p)[picks[:, k]] for k, (b, p) in enumerate(pairs)], 1)
    rise = np.stack([_rise(b, p, mount)[picks[:, k]] for k, (b, p) in enumerate(pairs)], 1)
    seen = reach[..., None] * np.stack([np.cos(azimuth), np.sin(azimuth)], -1)

    # Rigid alignment of what is seen from the axis with where the papers hang (Kabsch, in 2-D).
    seen_mean = seen.mean(1, keepdims=True)
    map_xy = paper_xyz[:, :2]
    a, b = seen - seen_mean, map_xy - map_xy.mean(0)
    cross = np.sum(a[..., 0] * b[:, 1] - a[..., 1] * b[:, 0], 1)
    heading = np.arctan2(cross, np.sum(a * b, (1, 2)))
    turn = se2.rotation(heading)
    axis = map_xy.mean(0) - np.einsum('nij,nj->ni', turn, seen_mean[:, 0])
    miss = np.einsum('nij,nkj->nki', turn, seen) + axis[:, None] - map_xy
    cost = np.sum((miss**2).sum(-1) / _blob_sigma(reach) ** 2 + rise**2, 1)
    fine = (cost < 60.0 * len(blobs)) & room.contains(axis)
    order = np.flatnonzero(fine)[np.argsort(cost[fine])][:_MAX_STARTS]
    lever = np.array([*mount.axis_xyz[:2], 0.0])
    starts = []
    for k in order:
        # Heights of blobs are rough; their directions are not.
        def residuals(pose: FloatArray, k: int = k) -> FloatArray:
            xy = se2.transform_points(se2.inverse(pose), map_xy)
            turn_off = wrap_rad(np.arctan2(xy[:, 1], xy[:, 0]) - azimuth[k])
            rise = (paper_xyz[:, 2] - mount.axis_xyz[2]) / np.hypot(xy[:, 0], xy[:, 1])
            return np.concatenate([turn_off / 0.004, (rise - tangent[k].mean(1)) / 0.01])

        fit = least_squares(residuals, [*axis[k], heading[k]])
        starts.append(se2.compose(fit.x, se2.inverse(lever)))
    return starts


class _PaperFitter:
    """
    Least squares of all paper edges over the pose and what is not exactly known.

    Parameters: x, y, heading of the base, height of the optical centre, horizon, and for each
    paper its offsets along the wall and upwards, all but the pose with priors.
    """

    def __init__(
        self, view: CylinderImage, room: Room, mount: PanTiltMount, config: ReferenceAreaConfig
    ) -> None:
        self._view, self._room, self._mount, self._config = view, room, mount, config
        blue, green, red = (c.astype(np.float64) for c in cv2.split(view.image))
        self._luminance = 0.114 * blue + 0.587 * green + 0.299 * red
        self._opponents = {p.color: opponent_image(view.image, p.color) for p in room.papers}
        self._edges = [_edge_points(paper, room) for paper in room.papers]
        offset = np.asarray(mount.camera_pose_base(0.0)[1])
        self._height = float(offset[2])
        sigma = max(config.paper_sigma_m, 1e-6)
        self._prior = np.array(
            [config.height_sigma_m, config.horizon_sigma_rad, *[sigma] * (2 * len(room.papers))]
        )

    def fit(self, start: FloatArray) -> _Fit | None:
        """Refine a start pose; None where the edges of the papers aren't there."""
        parameters = np.concatenate([start, np.zeros(2 + 2 * len(self._edges))])
        for _ in range(4):
            target, normal, sigma, found = self._measure(parameters)
            if min(found) < 0.3:
                return None

            result = least_squares(
                self._residuals,
                parameters,
                loss='huber',
                f_scale=2.0,
                x_scale='jac',
                args=(target, normal, sigma),
            )
            parameters = result.x
        edges = result.fun[: -len(self._prior)]
        spread = np.median(np.abs(edges)) / 0.6745
        if spread > 6.0:
            return None
        covariance = np.linalg.inv(result.jac.T @ result.jac) * max(1.0, spread**2)
        order = [0, 1, 3, 2]
        place = SweepPlace(
            parameters[:3],
            self._height + float(parameters[3]),
            covariance[np.ix_(order, order)],
        )
        return _Fit(place, float(np.mean(found)) / max(1.0, spread))

    def _residuals(
        self, p: FloatArray, target: FloatArray, normal: FloatArray, sigma: FloatArray
    ) -> FloatArray:
        """Distances of the edges found from where `p` has them, then the priors, in sigmas."""
        step = self._project(p) - target
        step[:, 0] = _wrapped_columns(step[:, 0], self._view.cylinder)
        edge = np.sum(step * normal, 1) / sigma
        return np.concatenate([edge[np.isfinite(edge)], p[3:] / self._prior])

    def _project(self, p: FloatArray) -> FloatArray:
        """Panorama pixels (n, 2) of all edge points."""
        shifted = [
            points + p[5 + 2 * k] * along + p[6 + 2 * k] * np.array([0.0, 0.0, 1.0])
            for k, (points, _, along) in enumerate(self._edges)
        ]
        return self._to_pixels(np.concatenate(shifted), p)

    def _to_pixels(self, points_map: FloatArray, p: FloatArray) -> FloatArray:
        axis = se2.compose(p[:3], [*self._mount.axis_xyz[:2], 0.0])
        xy = se2.transform_points(se2.inverse(axis), points_map[:, :2])
        rise = points_map[:, 2] - self._height - p[3] + p[4] * np.hypot(xy[:, 0], xy[:, 1])
        return self._view.cylinder.project(np.column_stack([xy, rise]))

    def _measure(self, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, list[float]]:
        """Find each edge near where `p` expects it: targets, normals, sigmas, shares found."""
        expected = self._project(p)
        outside = self._to_pixels(np.concatenate([q + 0.01 * o for q, o, _ in self._edges]), p)
        normal = outside - expected
        normal[:, 0] = _wrapped_columns(normal[:, 0], self._view.cylinder)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        targets, sigmas, shares = [], [], []
        per_paper = 4 * _SAMPLES_PER_EDGE
        for k, paper in enumerate(self._room.papers):
            part = slice(k * per_paper, (k + 1) * per_paper)
            edge = locate_edges(
                self._luminance,
                self._opponents[paper.color],
                self._view.cylinder,
                expected[part],
                normal[part],
            )
            targets.append(expected[part] + edge.offset_px[:, None] * normal[part])
            # Points of one edge share what shifts it, so that many of them don't add up.
            count = np.isfinite(edge.offset_px).reshape(4, -1).sum(1).repeat(_SAMPLES_PER_EDGE)
            shared = self._config.edge_sigma_px
            sigmas.append(np.sqrt(edge.sigma_px**2 + count * shared**2))
            shares.append(float(np.isfinite(edge.offset_px).mean()))
        return np.concatenate(targets), normal, np.concatenate(sigmas), shares


def _edge_points(paper: Paper, room: Room) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points on the four edges (4m, 3) in map, the outward direction of each, and the wall's."""
    wall = room.walls[int(room.nearest_wall(np.array(paper.center[:2])))]
    along = np.append(np.subtract(wall.end, wall.start) / wall.length, 0.0)
    up = np.array([0.0, 0.0, 1.0])
    share = np.linspace(-0.38, 0.38, _SAMPLES_PER_EDGE)[:, None]
    center = np.asarray(paper.center)
    points, outwards = [], []
    for side, other, half, length in (
        (along, up, paper.width / 2, paper.height),
        (-along, up, paper.width / 2, paper.height),
        (up, along, paper.height / 2, paper.width),
        (-up, along, paper.height / 2, paper.width),
    ):
        points.append(center + half * side + share * length * other)
        outwards.append(np.tile(side, (_SAMPLES_PER_EDGE, 1)))
    return np.concatenate(points), np.concatenate(outwards), along


def _wrapped_columns(difference: FloatArray, cylinder: Cylinder) -> FloatArray:
    half = cylinder.width / 2.0
    return np.asarray(np.mod(difference + half, cylinder.width) - half)


def _counted(papers: tuple[Paper, ...], blobs: list[PaperBlobs]) -> str:
    pairs = zip(papers, blobs, strict=True)
    return ', '.join(f'{len(b.azimuth_rad)} {p.color}' for p, b in pairs)


def _at(fit: _Fit) -> str:
    x, y, heading = fit.place.pose_map_base
    return f'{x:.2f} m, {y:.2f} m, {np.degrees(heading):.0f} deg'
