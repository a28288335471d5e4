"""
Projection of points of papers into the frames of a sweep, with all uncertain values.

Besides the pose these are height and tilt of the pan axis, the camera's response to light, the
shift between colour and brightness, the position of each paper, shift and rotation of each edge,
and the joint angles of each frame. All have priors, so that the covariance of a pose contains
their errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Paper, Room
from landmark_nav.parameters import Config
from landmark_nav.types import FloatArray, Sweep


@dataclass(frozen=True)
class ReferenceAreaConfig(Config):
    """
    Sigmas of given values of papers, camera and joints.

    They are chosen by hand; larger errors are detected and named.
    """

    # Sigma of the position of a paper.
    paper_sigma_m: float = 0.001
    # Sigma of the camera's height.
    height_sigma_m: float = 0.005
    # Sigma of the pan axis' tilt.
    horizon_sigma_rad: float = 0.003
    # Sigma of the error that all points of an edge share.
    edge_sigma_px: float = 0.05
    # Relative sigma of the size of papers.
    paper_size_sigma: float = 0.002


# Right, left, top and bottom as seen along the wall.
EDGES = 4
# Share of an edge's length on which its points lie.
EDGE_SHARE = 0.88

# x, y, heading of the base; height and two tilts of the axis; relative error of the size of all
# papers; gamma of colours, which JPEG blurs once more after the camera wrote them, and of
# brightness; shift of colours, two pixels.
RISE, SIZE, _PLACE, GAMMA, SHIFT, _COMMON = 3, 6, 7, 7, 9, 11

# Usual response to light, between linear and that of sRGB, and its sigma.
_USUAL_GAMMA, _GAMMA_SIGMA = 1.4, 0.4
_SHIFT_SIGMA_PX = 0.15
# Sigma of edges by brightness due to shadows.
_BRIGHT_SIGMA_PX = 0.2
# Sigma of an edge's rotation, at its ends, relative to that of its shift. Without it, a rotation
# by JPEG of 0.02 px in all frames is taken for a tilt of the axis, and that for a height.
_TURN_SHARE = 0.5


class PaperModel:
    """
    Projection of the papers' edges into the frames of a sweep.

    The unknowns are one array, see the indices below. `points` (papers, n, 3) lie on the edges in
    turn; `outwards` (papers, n, 3) are their directions from the paper to the wall.
    """

    def __init__(self, sweep: Sweep, room: Room, mount: PanTiltMount, per_edge: int) -> None:
        self._mount = mount
        self._camera = sweep.frames[0].camera
        self._angles = np.array([(f.pan_rad, f.tilt_rad, f.roll_rad) for f in sweep.frames])
        outlines = [_outline(paper, room, per_edge) for paper in room.papers]
        self.points = np.array([points for points, _, _ in outlines])
        self.outwards = np.array([outwards for _, outwards, _ in outlines])
        self._along = np.array([along for _, _, along in outlines])
        self._center = np.array([paper.center for paper in room.papers])
        self.papers = len(room.papers)
        self._edge = _COMMON + 2 * self.papers
        self._turn = self._edge + 2 * EDGES * self.papers
        self._frame = self._turn + 2 * EDGES * self.papers
        self.size = self._frame + 2 * len(sweep.frames)

    def start(self, pose_map_base: FloatArray) -> FloatArray:
        """Unknowns as they are before anything is measured, at a pose (3,)."""
        state = np.zeros(self.size)
        state[:3] = pose_map_base
        state[GAMMA:SHIFT] = _USUAL_GAMMA
        return state

    def hang(self, state: FloatArray) -> FloatArray:
        """How far along the wall and up papers hang from where they should, (papers, 2)."""
        return state[_COMMON : self._edge].reshape(self.papers, 2)

    def angles(self, state: FloatArray) -> FloatArray:
        """Corrections of pan and tilt, (frames, 2)."""
        return state[self._frame :].reshape(-1, 2)

    def edge_index(self, paper: IndexArray, edge: IndexArray, bright: IndexArray) -> IndexArray:
        """
        Indices (2, n) of what shifts an edge as a whole, and of what turns it.

        Both in its standard deviations: of all its points, and of its ends.
        """
        index = EDGES * (2 * paper + bright) + edge
        return np.stack([self._edge + index, self._turn + index])

    def axis_xy(self, state: FloatArray) -> FloatArray:
        """Place (2,) of the pan axis in map."""
        cos, sin = np.cos(state[2]), np.sin(state[2])
        x, y = self._mount.axis_xyz[:2]
        return np.array([state[0] + cos * x - sin * y, state[1] + sin * x + cos * y])

    def project(
        self, state: FloatArray, frame: IndexArray, paper: IndexArray, points: FloatArray
    ) -> FloatArray:
        """Pixels (n, 2) of points (n, 3) of papers (n,) in frames (n,)."""
        used = np.unique(frame)
        turn = self.angles(state)[used]
        rotation, center = self._mount.camera_pose_base(
            self._angles[used, 0] + turn[:, 0],
            self._angles[used, 1] + turn[:, 1],
            self._angles[used, 2],
        )
        hang = self.hang(state)[paper]
        offset = points + state[SIZE] * (points - self._center[paper])
        offset += hang[:, :1] * self._along[paper]
        offset[:, 2] += hang[:, 1] - state[RISE]
        offset[:, :2] -= state[:2]
        cos, sin = np.cos(state[2]), np.sin(state[2])
        axis = np.asarray(self._mount.axis_xyz)
        base = offset @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) - axis
        # Small tilts of the axis, about the base's x and y.
        base = base - np.cross([state[4], state[5], 0.0], base) + axis
        place = np.searchsorted(used, frame)
        seen = np.einsum('nji,nj->ni', rotation[place], base - center[place])
        return self._camera.project(seen)

    def jacobian(
        self,
        state: FloatArray,
        frame: IndexArray,
        paper: IndexArray,
        points: FloatArray,
        normal: FloatArray,
    ) -> FloatArray:
        """Derivative (n, size) of `project` along `normal` (n, 2), by finite differences."""
        here = self.project(state, frame, paper, points)
        rows = np.arange(len(points))
        columns = [np.full(len(points), k) for k in range(_PLACE)]
        columns += [_COMMON + 2 * paper + k for k in (0, 1)]
        columns += [self._frame + 2 * frame + k for k in (0, 1)]
        jacobian = np.zeros((len(points), self.size))
        for column in columns:
            # A point depends on one unknown of each kind, so all of a kind are moved at once.
            moved = state.copy()
            moved[np.unique(column)] += 1e-5
            change = self.project(moved, frame, paper, points) - here
            jacobian[rows, column] = np.sum(change * normal, 1) / 1e-5
        return jacobian

    def prior(self, config: ReferenceAreaConfig, angle_sigma_rad: FloatArray) -> FloatArray:
        """Information (size,) of the unknowns; `angle_sigma_rad` (2,) of pan and tilt."""
        sigma = np.ones(self.size)
        sigma[RISE:_PLACE] = (
            config.height_sigma_m,
            config.horizon_sigma_rad,
            config.horizon_sigma_rad,
            config.paper_size_sigma,
        )
        sigma[GAMMA:SHIFT], sigma[SHIFT:_COMMON] = _GAMMA_SIGMA, _SHIFT_SIGMA_PX
        sigma[_COMMON : self._edge] = max(config.paper_sigma_m, 1e-6)
        sigma[self._frame :].reshape(-1, 2)[:] = angle_sigma_rad
        information = sigma**-2.0
        information[:3] = 1e-4  # regularizes directions without measurements
        return np.asarray(information)


def edge_sigma_px(config: ReferenceAreaConfig, bright: IndexArray) -> FloatArray:
    """Sigmas (2, n) of the shift and of the rotation of edges (n,)."""
    shift = np.hypot(config.edge_sigma_px, np.where(bright > 0, _BRIGHT_SIGMA_PX, 0.0))
    return np.stack([shift, np.full(len(bright), _TURN_SHARE * config.edge_sigma_px)])


def _outline(paper: Paper, room: Room, per_edge: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points on the four edges (n, 3) in map, their outward directions, and that of the wall."""
    wall = room.walls[int(room.nearest_wall(np.array(paper.center[:2])))]
    along = np.append(wall.along, 0.0)
    up = np.array([0.0, 0.0, 1.0])
    share = np.linspace(-0.5, 0.5, per_edge)[:, None]
    center = np.asarray(paper.center)
    points, outwards = [], []
    for side, other, half, length in (
        (along, up, paper.width / 2, paper.height),
        (-along, up, paper.width / 2, paper.height),
        (up, along, paper.height / 2, paper.width),
        (-up, along, paper.height / 2, paper.width),
    ):
        points.append(center + half * side + EDGE_SHARE * share * length * other)
        outwards.append(np.tile(side, (per_edge, 1)))
    return np.concatenate(points), np.concatenate(outwards), along
