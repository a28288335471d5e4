"""
Where papers are seen, with all uncertain values: in a panorama, and in the frames of a sweep.

All parts of the reference area use `in_base`, which depends on the pose and on height and tilt of
the pan axis, and `PaperPlaces.outlines`, which adds errors of the papers. In frames there are also
the camera's response to light, the shift between colour and brightness, shift and rotation of each
edge, and the joint angles of each frame. All have priors, so that the covariance of a pose
contains their errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from landmark_nav.arrays import IndexArray
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.parameters import Config
from landmark_nav.types import FloatArray, Sweep


@dataclass(frozen=True)
class ReferenceAreaConfig(Config):
    """
    Sigmas of given values of papers, camera and joints.

    They are chosen by hand; larger errors are detected and named.
    """

    # Sigmas of the position of a paper, of the camera's height, and of the pan axis' tilt.
    paper_sigma_m: float = 0.001
    height_sigma_m: float = 0.005
    horizon_sigma_rad: float = 0.003
    # Sigma of the error that all points of an edge share.
    edge_sigma_px: float = 0.05
    # Relative sigma of the size of papers.
    paper_size_sigma: float = 0.002
    # Sigma of the optical centre, forward and left; each sweep sets it by what it knows.
    center_sigma_m: float = 0.0


# Sigmas of a room and a robot as a person measures them.
MEASURED = ReferenceAreaConfig()

# Errors of each paper in `PaperPlaces.outlines`: of its place, m, and of its sizes, relative.
OF_PAPER = ('along', 'height', 'depth', 'width', 'tallness', 'size')
_NO_ERRORS = np.zeros(len(OF_PAPER))
_UP, _RISES = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
# Least distance of a paper, for candidates of poses.
_NEAREST_M = 0.1
# Step of numerical differentiation.
_STEP = 1e-6


def in_base(points: FloatArray, axis_pose: FloatArray, mount: FloatArray) -> FloatArray:
    """
    Vectors (..., 3) from the camera to points (..., 3) in map, along the axes of the base, m.

    `axis_pose` (..., 3) are x, y (m) and heading (rad) of the pan axis in map; `mount` (..., 3)
    are the height of the camera (m) and small rotations of the axis about x and y of the base.
    """
    dx, dy, level = np.moveaxis(points, -1, 0)
    cos, sin = np.cos(axis_pose[..., 2]), np.sin(axis_pose[..., 2])
    dx, dy, level = dx - axis_pose[..., 0], dy - axis_pose[..., 1], level - mount[..., 0]
    ahead, aside = cos * dx + sin * dy, cos * dy - sin * dx
    roll, pitch = mount[..., 1], mount[..., 2]
    return np.stack(
        [ahead - pitch * level, aside + roll * level, level + pitch * ahead - roll * aside], -1
    )


@dataclass(frozen=True, eq=False)
class PaperPlaces:
    """
    Papers as given, arrays over k papers.

    `center` (k, 3) in map and `size` (k, 2), width and height, m; unit vectors (k, 3) `along` the
    wall, to the left as seen from inside, and `normal`, into the room.
    """

    center: FloatArray
    size: FloatArray
    along: FloatArray
    normal: FloatArray

    @classmethod
    def of(cls, room: Room) -> PaperPlaces:
        """Return the papers of a room."""
        sizes = [(paper.width, paper.height) for paper in room.papers]
        return cls.hung(room, [paper.center for paper in room.papers], sizes)

    @classmethod
    def hung(
        cls, room: Room, centers: Sequence[Sequence[float]], sizes: Sequence[Sequence[float]]
    ) -> PaperPlaces:
        """Return sheets with centres (k, 3) and sizes (k, 2) on the walls nearest to them."""
        center, size = np.reshape(centers, (-1, 3)), np.reshape(sizes, (-1, 2))
        normal = room.normals[room.nearest_wall(center[:, :2])]
        along = np.stack([normal[:, 1], -normal[:, 0], normal[:, 2]], 1)
        return cls(center, size, along, normal)

    def chosen(self, index: IndexArray) -> PaperPlaces:
        """Return the papers of indices (n,), which may repeat."""
        parts = (self.center, self.size, self.along, self.normal)
        return PaperPlaces(*(part[index] for part in parts))

    def outlines(
        self,
        axis_pose: FloatArray,
        mount: FloatArray,
        errors: FloatArray = _NO_ERRORS,
        size: FloatArray = _NO_ERRORS[:1],
    ) -> FloatArray:
        """
        Azimuths of right and left edges, tangents of elevation of bottom and top, (..., k, 4).

        Parameters
        ----------
        axis_pose, mount : ndarray, shape (..., k or 1, 3)
            See `in_base`.
        errors : ndarray, shape (..., k, 6)
            Errors of each paper, in the order of `OF_PAPER`: to the left, up and off the wall,
            m; of width, height and both, relative.
        size : ndarray, shape (..., k or 1)
            Relative error of the sizes of all papers.
        """
        center = self.center + errors[..., :1] * self.along + errors[..., 1:2] * _UP
        center = center + errors[..., 2:3] * self.normal
        half = 0.5 * self.size * (1.0 + size[..., None] + errors[..., 3:5] + errors[..., 5:])
        side = half[..., :1] * self.along
        ends = np.stack([center - side, center + side], -2)
        ends = in_base(ends, axis_pose[..., None, :], mount[..., None, :])
        right, left = np.moveaxis(np.arctan2(ends[..., 1], ends[..., 0]), -1, 0)
        # Tangents are those at the middle azimuth: the bisector divides the paper in the ratio of
        # the distances of its ends.
        reach = np.hypot(ends[..., 0], ends[..., 1])
        share = (reach / reach.sum(-1, keepdims=True))[..., ::-1, None]
        middle = np.sum(share * ends, -2)
        distance = np.maximum(np.hypot(middle[..., 0], middle[..., 1]), _NEAREST_M)
        bottom, top = ((middle[..., 2] + up * half[..., 1]) / distance for up in (-1.0, 1.0))
        return np.stack([right, right + wrap_rad(left - right), bottom, top], -1)


def linearized(
    of: Callable[[FloatArray], FloatArray], states: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Azimuths and tangents `of` states (..., n), (..., m), and their derivatives (..., n, m)."""
    count = states.shape[-1]
    found = of(states[..., None, :] + _STEP * np.eye(count + 1, count, -1))
    return found[..., 0, :], np.asarray(wrap_rad(found[..., 1:, :] - found[..., :1, :]) / _STEP)


# Right, left, top and bottom as seen along the wall.
EDGES = 4
# Share of an edge's length on which its points lie.
EDGE_SHARE = 0.88
# x, y, heading of the base; height and two tilts of the axis; relative error of the size of all
# papers; shift of the optical centre, forward and left; gamma of colours, which JPEG blurs once
# more after the camera wrote them, and of brightness; shift of colours, two pixels.
RISE, SIZE, _PLACE, GAMMA, SHIFT, _COMMON = 3, 6, 9, 9, 11, 13
CENTERED = slice(7, _PLACE)

# Usual response to light, between linear and that of sRGB, and its sigma.
_USUAL_GAMMA, _GAMMA_SIGMA = 1.4, 0.4
_SHIFT_SIGMA_PX = 0.15


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
        self._places = PaperPlaces.of(room)
        self.points, self.outwards = _edge_points(self._places, per_edge)
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

    def edge_index(self, paper: IndexArray, edge: IndexArray, bright: IndexArray) -> IndexArray:
        """Indices (2, n) of the shift of edges and of the rotation at their ends, in sigmas."""
        index = EDGES * (2 * paper + bright) + edge
        return np.stack([self._edge + index, self._turn + index])

    def project(
        self, state: FloatArray, frame: IndexArray, paper: IndexArray, points: FloatArray
    ) -> FloatArray:
        """Pixels (n, 2) of points (n, 3) of papers (n,) in frames (n,)."""
        used = np.unique(frame)
        turn = state[self._frame :].reshape(-1, 2)[used]
        x, y, z = self._mount.optical_center_offset
        forward, left = state[CENTERED].tolist()
        mount = replace(self._mount, optical_center_offset=(x + forward, y + left, z))
        rotation, center = mount.camera_pose_base(
            self._angles[used, 0] + turn[:, 0],
            self._angles[used, 1] + turn[:, 1],
            self._angles[used, 2],
        )
        hang, places = self.hang(state)[paper], self._places
        hung = points + state[SIZE] * (points - places.center[paper])
        hung += hang[:, :1] * places.along[paper] + hang[:, 1:] * _UP
        axis = np.asarray(self._mount.axis_xyz)
        axis_pose = self._mount.axis_pose_map(state[:3])
        base = in_base(hung, axis_pose, state[RISE:SIZE] + axis[2] * _RISES)
        place = np.searchsorted(used, frame)
        seen = np.einsum('nji,nj->ni', rotation[place], base + axis - center[place])
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

    def prior(self, config: ReferenceAreaConfig, angle_sigma_rad: float) -> FloatArray:
        """Information (size,) of the unknowns; `angle_sigma_rad` of pan and tilt of a frame."""
        sigma = np.ones(self.size)
        sigma[RISE : SIZE + 1] = (
            config.height_sigma_m,
            config.horizon_sigma_rad,
            config.horizon_sigma_rad,
            config.paper_size_sigma,
        )
        sigma[CENTERED] = max(config.center_sigma_m, 1e-6)
        sigma[GAMMA:SHIFT], sigma[SHIFT:_COMMON] = _GAMMA_SIGMA, _SHIFT_SIGMA_PX
        sigma[_COMMON : self._edge] = max(config.paper_sigma_m, 1e-6)
        sigma[self._frame :] = angle_sigma_rad
        information = sigma**-2.0
        information[:3] = 1e-4  # regularizes directions without measurements
        return np.asarray(information)


def _edge_points(places: PaperPlaces, per_edge: int) -> tuple[FloatArray, FloatArray]:
    """Points (papers, n, 3) on the four edges in turn, and their directions outwards."""
    share = np.linspace(-0.5, 0.5, per_edge)[:, None]
    points, outwards = [], []
    for center, (width, height), left in zip(
        places.center, places.size, places.along, strict=True
    ):
        edges = ((left, width, height * _UP), (_UP, height, width * left))
        for side, across, along in edges:
            for outward in (side, -side):
                points.append(center + 0.5 * across * outward + EDGE_SHARE * share * along)
                outwards.append(np.tile(outward, (per_edge, 1)))
    shape = (len(places.center), EDGES * per_edge, 3)
    return np.reshape(points, shape), np.reshape(outwards, shape)
