"""Pose of a sweep by robust least squares over the edges of all papers in its frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.least_squares import covariance_of, solve_positive
from landmark_nav.learning.reference_area.blobs import hue_direction
from landmark_nav.learning.reference_area.edges import locate_edges, PROFILES
from landmark_nav.learning.reference_area.model import (
    CENTERED,
    EDGE_SHARE,
    EDGES,
    GAMMA,
    PaperModel,
    ReferenceAreaConfig,
    RISE,
    SHIFT,
    SIZE,
)
from landmark_nav.learning.reference_area.search import papers_in_view
from landmark_nav.types import FloatArray, Sweep

# Number of measurements along each edge of a paper in each frame.
_PARTS = 4
# Greatest number of frames that are used for a paper.
MOST_FRAMES = 12
# Reach of the profiles across edges in successive rounds; and for each round the squared residuals
# (sigmas) at which weights fall to a quarter, which decrease as the fit converges.
_SEARCH_PX = (13.0, 8.0, 7.0)
_TAIL_WIDTHS = ((400.0, 100.0, 40.0), (60.0, 25.0, 12.0), (12.0, 9.0, 9.0))
# Sigma of edges by brightness due to shadows.
_BRIGHT_SIGMA_PX = 0.2
# Sigma of an edge's rotation, at its ends, relative to that of its shift. Without it, a rotation
# by JPEG of 0.02 px in all frames is taken for a tilt of the axis, and that for a height.
_TURN_SHARE = 0.5
# Greatest squared residual of an inlier, in sigmas.
_SURELY_WRONG = 25.0
# Least width of a paper in a frame; and width below which colour edges have a further sigma, as
# JPEG mixes the colours of narrow papers and the wall.
_LEAST_WIDTH_PX, _NARROW_PX = 4.5, 7.0
_NARROW_COLOR_SIGMA_PX = 1.0
# Least distance of measurements from the corners, and least share of an edge that is measured.
_CORNER_PX, _LEAST_KEPT = 2.5, 0.2
_GAMMA_RANGE = (0.8, 2.4)


@dataclass(frozen=True, eq=False)
class PaperFit:
    """
    Pose of the base by the papers, and how well they fit.

    `pose_map_base` (3,) is the pose of the base in map, `covariance` (4, 4) that of x, y, height
    and heading. `seen` (papers,) is the share of the edges of each paper that was found, `agreed`
    (papers,) the share of inliers among these. `hang_m` (papers, 2) is the displacement of each
    paper from its given location, along the wall and up. `mount` (3,) are height of the camera (m)
    and rotations of the pan axis about x and y of the base (rad) relative to the given ones,
    `mount_covariance` (3, 3) is their covariance, including the prior. `size` is the relative
    excess of the sizes of all papers over the given ones, `size_sigma` its sigma, including the
    prior. `center_m` (2,) is the displacement of the optical centre, forward and left. `misfit` is
    the mean squared residual, in sigmas.
    """

    pose_map_base: FloatArray
    covariance: FloatArray
    seen: FloatArray
    agreed: FloatArray
    hang_m: FloatArray
    mount: FloatArray
    mount_covariance: FloatArray
    size: float
    size_sigma: float
    center_m: FloatArray
    misfit: float


@dataclass(frozen=True, eq=False)
class _Measured:
    """Measurements of edges with one gamma, arrays over n; of `tried` (papers,) by colour."""

    tried: IndexArray
    gamma: float
    by_gamma: FloatArray
    paper: IndexArray
    frame: IndexArray
    edge: IndexArray
    along: FloatArray  # from -1 to 1 along each edge
    points: FloatArray
    normal: FloatArray
    bright: IndexArray  # 1 for measurements of brightness, 0 for those of colour
    offset_px: FloatArray
    sigma_px: FloatArray


class PaperFitter:
    """Fits poses of the base to the papers in the frames of one sweep."""

    def __init__(
        self, sweep: Sweep, room: Room, mount: PanTiltMount, config: ReferenceAreaConfig
    ) -> None:
        self._frames, self._room, self._config = sweep.frames, room, config
        self._mount = mount
        self._model = PaperModel(sweep, room, mount, _PARTS * PROFILES)
        self._hues = [hue_direction(paper.color) for paper in room.papers]

    def fit(
        self,
        pose_map_base: FloatArray,
        frames_per_paper: int = MOST_FRAMES,
        mount: FloatArray | None = None,
        center_m: FloatArray | None = None,
    ) -> PaperFit | None:
        """
        Refine an approximate pose (3,) of the base; None if no paper is in view or it diverges.

        `mount` (3,) and `center_m` (2,) are approximate errors as in `PaperFit`. Fewer frames are
        faster, and suffice to choose between poses.
        """
        state = self._model.start(pose_map_base)
        if mount is not None:
            state[RISE:SIZE] = mount
        if center_m is not None:
            state[CENTERED] = center_m
        fit = None
        for reach, tail_widths in zip(_SEARCH_PX, _TAIL_WIDTHS, strict=True):
            measured = self._measure(state, frames_per_paper, reach)
            if measured is None:
                return None
            base = state
            for tail_width in tail_widths:
                try:
                    state, fit = self._solve(measured, base, state, tail_width)
                except LandmarkNavError:
                    return None  # the fit diverges
        return fit

    def _measure(self, state: FloatArray, most: int, reach_px: float) -> _Measured | None:
        """Measure the edges of papers in the frames that show them; None if there are none."""
        model, middle = self._model, slice(PROFILES // 2, None, PROFILES)
        gamma = float(np.clip(state[GAMMA], *_GAMMA_RANGE))
        side = np.repeat(np.arange(EDGES), _PARTS)
        along = np.tile(np.linspace(-1.0, 1.0, _PARTS), EDGES)
        tried = np.zeros(model.papers, np.intp)
        columns = []
        for k, f in self._views(state, most):
            paper, frame = np.full((2, model.points.shape[1]), [[k], [f]])
            points = _off_the_corners(
                model.points[k], model.project(state, frame, paper, model.points[k])
            )
            pixels = model.project(state, frame, paper, points)
            beyond = model.project(state, frame, paper, points + 0.004 * model.outwards[k])
            if not np.all(np.isfinite(pixels + beyond)):
                continue
            width = float(np.ptp(pixels, axis=0).min())
            if width < _LEAST_WIDTH_PX:
                continue
            normal = _normals(pixels, beyond - pixels)
            reach = min(reach_px, max(5.0, 0.6 * width))
            image, hue = self._frames[f].image, self._hues[k]
            found = locate_edges(image, pixels, normal, hue, reach, gamma)
            tried[k] += len(side)
            found.sigma_px[0] += _NARROW_COLOR_SIGMA_PX * (width < _NARROW_PX)
            place = paper[middle], frame[middle], side, along, points[middle], normal[middle]
            for kind, *measured in zip(
                (0, 1), found.offset_px, found.sigma_px, found.by_gamma, strict=True
            ):
                good = np.isfinite(measured[0])
                parts = (*place, np.full(len(side), kind), *measured)
                columns.append([part[good] for part in parts])
        if not columns:
            return None
        *others, by_gamma = map(np.concatenate, zip(*columns, strict=True))
        paper, _, edge, _, _, _, bright, *_ = others
        # The noise of an edge and that of its slope are correlated, which would bias gamma: slopes
        # are averaged.
        _, group = np.unique(paper * 8 + edge * 2 + bright, return_inverse=True)
        by_gamma = (np.bincount(group, by_gamma) / np.bincount(group))[group]
        return _Measured(tried, gamma, by_gamma, *others)

    def _views(self, state: FloatArray, most: int) -> list[tuple[int, int]]:
        """Pairs of paper and frame, for the frames that show the paper nearest to the middle."""
        camera = self._frames[0].camera
        half = 0.5 * np.array([camera.width, camera.height])
        frames = np.arange(len(self._frames))
        pairs = []
        axis_xy = self._mount.axis_pose_map(state[:3])[:2]
        for k in np.flatnonzero(papers_in_view(axis_xy, self._room)):
            center = np.tile(self._model.points[k].mean(axis=0), (len(frames), 1))
            pixels = self._model.project(state, frames, np.full(len(frames), k), center)
            off = np.abs(pixels - half)
            shown = np.isfinite(off).all(axis=1) & (off < half).all(axis=1)
            order = np.flatnonzero(shown)[np.argsort(np.linalg.norm(off[shown], axis=1))]
            pairs += [(int(k), int(f)) for f in order[:most]]
        return pairs

    def _solve(
        self, m: _Measured, base: FloatArray, state: FloatArray, tail_width: float
    ) -> tuple[FloatArray, PaperFit]:
        """One step of reweighted Gauss-Newton from `state`; edges were measured at `base`."""
        model = self._model
        each_px = self._config.edge_sigma_px
        shift = np.hypot(each_px, np.where(m.bright > 0, _BRIGHT_SIGMA_PX, 0.0))
        moved = model.project(state, m.frame, m.paper, m.points)
        moved -= model.project(base, m.frame, m.paper, m.points)
        jacobian = model.jacobian(state, m.frame, m.paper, m.points, m.normal)
        rows = np.arange(len(m.bright))
        jacobian[rows, GAMMA + m.bright] = -m.by_gamma
        jacobian[:, SHIFT : SHIFT + 2] = np.where(m.bright[:, None] > 0, 0.0, m.normal)
        innovation = (
            m.offset_px
            - np.sum(moved * m.normal, 1)
            + m.by_gamma * (state[GAMMA + m.bright] - m.gamma)
            - jacobian[:, SHIFT : SHIFT + 2] @ state[SHIFT : SHIFT + 2]
        )
        squared_misfit = innovation**2 / (m.sigma_px**2 + shift**2)
        weight = (1.0 + squared_misfit / tail_width) ** -2.0 / m.sigma_px**2
        weight[squared_misfit > 4.0 * tail_width] = 0.0
        edge = model.edge_index(m.paper, m.edge, m.bright)
        by_edge = np.stack([shift, _TURN_SHARE * each_px * m.along])
        jacobian[rows, edge] = by_edge

        prior = model.prior(self._config, self._mount.pan_sigma_rad)
        usual = model.start(state[:3])
        information = (jacobian * weight[:, None]).T @ jacobian + np.diag(prior)
        left = innovation - np.sum(by_edge * state[edge], 0)
        right = jacobian.T @ (weight * left) + prior * (usual - state)
        covariance = covariance_of(information)
        step = solve_positive(information, right)
        state = state + step

        left = left - jacobian @ step
        usual[:3] = state[:3]
        chi = np.sum(weight * left**2) + np.sum(prior * (state - usual) ** 2)
        misfit = float(chi / max(1.0, np.sum(weight * m.sigma_px**2) - 3.0))
        covariance = covariance * max(1.0, misfit)

        by_color = m.bright == 0
        found = np.bincount(m.paper[by_color], minlength=model.papers)
        agreed = by_color & (squared_misfit < _SURELY_WRONG)
        order, mount = [0, 1, 3, 2], slice(RISE, SIZE)
        return state, PaperFit(
            state[:3].copy(),
            covariance[np.ix_(order, order)],
            found / np.maximum(m.tried, 1),
            np.bincount(m.paper[agreed], minlength=model.papers) / np.maximum(found, 1),
            model.hang(state).copy(),
            state[mount].copy(),
            covariance[mount, mount],
            float(state[SIZE]),
            float(np.sqrt(covariance[SIZE, SIZE])),
            state[CENTERED].copy(),
            misfit,
        )


def _off_the_corners(points: FloatArray, pixels: FloatArray) -> FloatArray:
    """Move points (n, 3) of the four edges off the corners, which blur rounds, to the middles."""
    edges, shown = points.reshape(EDGES, -1, 3), pixels.reshape(EDGES, -1, 2)
    middle = edges.mean(axis=1, keepdims=True)
    half_px = 0.5 * np.linalg.norm(shown[:, -1] - shown[:, 0], axis=1)
    kept = 1.0 / EDGE_SHARE - _CORNER_PX / np.maximum(half_px, 0.1)
    drawn = middle + np.clip(kept, _LEAST_KEPT, 1.0)[:, None, None] * (edges - middle)
    return np.asarray(drawn.reshape(-1, 3))


def _normals(pixels: FloatArray, outwards: FloatArray) -> FloatArray:
    """Unit normals (n, 2) at points of the four edges, on the side of `outwards` (n, 2)."""
    edges = pixels.reshape(EDGES, -1, 2)
    along = np.asarray(np.gradient(edges, axis=1)).reshape(-1, 2)
    normal = np.stack([along[:, 1], -along[:, 0]], 1)
    normal *= np.sign(np.sum(normal * outwards, 1, keepdims=True))
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9))
