"""Parameters of planning, and visibility of walls in panoramas from given positions."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment.problem import AdjustmentConfig
from landmark_nav.learning.election import ElectionConfig
from landmark_nav.learning.reference_area.common_errors import least_in_view, pose_errors
from landmark_nav.learning.stereo.wall_patch import StereoConfig
from landmark_nav.learning.unmeasured import RELATIVE_SIGMA
from landmark_nav.localization.triplet.visibility import TripletConfig
from landmark_nav.parameters import Config
from landmark_nav.types import FloatArray


@dataclass(frozen=True)
class PlanConfig(Config):
    """
    Camera, expected texture, and sampling of the room.

    The bounds of learning and localization are those of their own parameters.
    """

    focal_px: float = 555.0
    width_px: int = 512
    height_px: int = 512
    pan_min_rad: float = -np.pi
    pan_max_rad: float = np.pi
    # View of the camera above the horizontal.
    camera_tilt_rad: float = 0.0
    # Smallest distance of the robot from walls.
    clearance_m: float = 0.4
    # Smallest spacing of floor points and of wall samples.
    spacing_m: float = 0.25
    # Number of patches that attention proposes in a panorama.
    candidates: int = 120
    # Heights between which walls are assumed to be textured.
    texture_low_m: float = 0.8
    texture_high_m: float = 2.0
    # Number of random sets of positions for comparison.
    random_sets: int = 50
    stereo: StereoConfig = field(default_factory=StereoConfig)
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    election: ElectionConfig = field(default_factory=ElectionConfig)
    triplet: TripletConfig = field(default_factory=TripletConfig)

    @property
    def elevations(self) -> tuple[float, float]:
        """Least and largest tangent of elevation in panoramas."""
        half = np.arctan((0.5 * self.height_px - self.triplet.border_px) / self.focal_px)
        # Up to a right angle, exclusively.
        low, high = np.clip(self.camera_tilt_rad + np.array([-half, half]), -1.57, 1.57)
        return float(np.tan(low)), float(np.tan(high))

    @property
    def half_arc_rad(self) -> float:
        """Largest azimuth that the camera sees to either side of the middle of its pan range."""
        half_fov = float(np.arctan(0.5 * self.width_px / self.focal_px))
        return min(float(np.pi), 0.5 * (self.pan_max_rad - self.pan_min_rad) + half_fov)

    @property
    def paper_pans_rad(self) -> tuple[float, ...]:
        """Pans toward the papers that are tried for a sweep."""
        if self.half_arc_rad == np.pi:
            return (0.0,)
        middle = 0.5 * (self.pan_min_rad + self.pan_max_rad)
        quarter = 0.25 * (self.pan_max_rad - self.pan_min_rad)
        return (middle, middle - quarter, middle + quarter)


class WallSamples(NamedTuple):
    """Points `xy` (s, 2) on walls: normal (s, 2), index and height of the wall, length (s,)."""

    xy: FloatArray
    normal: FloatArray
    wall: npt.NDArray[np.intp]
    wall_height_m: FloatArray
    length_m: FloatArray


def free_floor(room: Room, clearance_m: float, spacing_m: float, most: int) -> FloatArray:
    """
    Grid (n, 2) of possible positions of the robot, row by row; empty in too narrow a room.

    The spacing is larger if there would be more than `most` points.
    """
    low, high = room.bounds[0] + clearance_m, room.bounds[1] - clearance_m
    if np.any(high < low):
        return np.zeros((0, 2))
    spacing = max(spacing_m, float(np.sqrt(np.prod(high - low) / most)))
    # The grid includes both ends, so that it is equally near to all walls.
    steps = np.floor((high - low) / spacing + 1e-9).astype(int) + 1
    x, y = (
        np.linspace(a, b, n) if n > 1 else np.array([0.5 * (a + b)])
        for a, b, n in zip(low, high, steps, strict=True)
    )
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return grid[is_free(room, clearance_m, grid)]


def is_free(room: Room, clearance_m: float, xy: FloatArray) -> npt.NDArray[np.bool_]:
    """Whether points (n, 2) are inside the room, `clearance_m` or more from the walls."""
    clear = room.wall_distances(xy).min(axis=1) >= clearance_m - 1e-9
    return np.asarray(room.contains(xy) & clear)


def sample_walls(room: Room, spacing_m: float, most: int) -> WallSamples:
    """Centres of equal pieces of each wall, about `spacing_m` long, about `most` in total."""
    spacing = max(spacing_m, sum(wall.length for wall in room.walls) / most)
    parts = []
    for k, (wall, normal) in enumerate(zip(room.walls, room.normals, strict=True)):
        count = max(1, round(wall.length / spacing))
        share = (np.arange(count) + 0.5)[:, None] / count
        xy = np.array(wall.start) + share * np.subtract(wall.end, wall.start)
        constant = np.tile([*normal[:2], k, wall.height, wall.length / count], (count, 1))
        parts.append(np.column_stack([xy, constant]))
    table = np.concatenate(parts)
    return WallSamples(
        table[:, :2], table[:, 2:4], table[:, 4].astype(np.intp), table[:, 5], table[:, 6]
    )


# Smallest visible size of a paper that is found by its colour, and of a marker, whose nine cells
# or fewer are two pixels wide; pixels. Largest angle of incidence.
_MIN_PAPER_PX, _MIN_MARKER_PX = 8.0, 18.0
_MAX_PAPER_INCIDENCE_RAD = 1.2


@dataclass(frozen=True, eq=False)
class Views:
    """
    Visibility of s wall samples from p poses (p, 3) of the base.

    The viewpoint `eye` is the pan axis at the height of the optical centre, in map. `covariance`
    (p, 3, 3) is that of x, y and heading of the pan axis, by papers or markers, or else by the
    relative poses of panoramas; `by_papers` (p, 3, m) are loadings of the errors of papers, which
    all poses share; the factors have unit variance. By pose and sample (p, s): azimuth in map and
    range; `share` of the textured band that is in the image, 0 if a sample is hidden or seen too
    obliquely to be matched; `proposed`, the expected number of patches that attention proposes and
    that can become landmarks.
    """

    pose_map_base: FloatArray
    eye: FloatArray
    covariance: FloatArray
    by_papers: FloatArray
    azimuth_rad: FloatArray
    range_m: FloatArray
    share: FloatArray
    proposed: FloatArray

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.eye)


def ahead_rad(floor_xy: FloatArray, room: Room) -> FloatArray:
    """Azimuths (n,) in map from points (n, 2) to the centre of the papers, or of the room."""
    hung = [paper.center[:2] for paper in room.anchors] or room.bounds
    ahead = np.mean(hung, axis=0) - floor_xy
    return np.asarray(np.arctan2(ahead[:, 1], ahead[:, 0]))


def sweep_poses(
    floor_xy: FloatArray, room: Room, mount: PanTiltMount, config: PlanConfig
) -> FloatArray:
    """Poses (k n, 3) of the base at points (n, 2): the camera sees the papers at k pans."""
    ahead = ahead_rad(floor_xy, room)
    pans = mount.azimuth_base_rad(np.array(config.paper_pans_rad))
    return np.concatenate([np.column_stack([floor_xy, wrap_rad(ahead - pan)]) for pan in pans])


def look(
    poses_map_base: FloatArray,
    samples: WallSamples,
    room: Room,
    mount: PanTiltMount,
    config: PlanConfig,
) -> Views:
    """
    Compute the visibility of wall samples from poses (n, 3) that see enough papers or markers.

    A sweep at other poses cannot be located; in a room without them all are taken.
    """
    axis = mount.axis_pose_map(poses_map_base)[:, :2]
    eye = np.column_stack(
        [axis, np.full(len(axis), mount.camera_pose_base(0.0, config.camera_tilt_rad)[1][2])]
    )
    middle_pan = np.array(0.5 * (config.pan_min_rad + config.pan_max_rad))
    middle = poses_map_base[:, 2] + mount.azimuth_base_rad(middle_pan)
    measured = np.ones(len(eye), dtype=np.bool_)
    if room.anchors:
        hung = np.array([paper.center[:2] for paper in room.anchors]) - axis[:, None]
        papers = papers_seen(eye, room, config)
        papers &= _on_arc(np.arctan2(hung[..., 1], hung[..., 0]), middle, config)
        measured = papers.sum(axis=1) >= least_in_view(room)
    eye = eye[measured]
    way = samples.xy - eye[:, None, :2]
    reach = np.maximum(np.linalg.norm(way, axis=-1), 1e-3)
    azimuth = np.arctan2(way[..., 1], way[..., 0])
    cosine = -np.sum(way * samples.normal, -1) / reach
    share = band_share(reach, eye[:, 2:], samples, config)
    share[cosine < np.cos(config.stereo.max_incidence_rad)] = 0.0
    share[~room.visible(eye[:, None, :2], samples.xy)] = 0.0
    share[~_on_arc(azimuth, middle[measured], config)] = 0.0
    # Attention works on the image: patches are evenly distributed over azimuth, not over metres of
    # wall. A part of the turn has only its part of the patches, since patches do not overlap.
    proposed = config.candidates / (2.0 * np.pi) * samples.length_m * cosine / reach * share
    proposed[cosine < np.cos(config.election.max_incidence_rad)] = 0.0
    if room.anchors:
        errors = pose_errors(eye, room, config.focal_px, papers[measured])
    else:
        plan = np.diag(RELATIVE_SIGMA[[0, 1, 3]] ** 2)
        errors = np.tile(plan, (len(eye), 1, 1)), np.zeros((len(eye), 3, 1))
    return Views(
        poses_map_base[measured], eye, *errors, azimuth, reach, share, np.maximum(proposed, 0.0)
    )


def papers_seen(eye: FloatArray, room: Room, config: PlanConfig) -> npt.NDArray[np.bool_]:
    """Whether anchors can be measured in panoramas from viewpoints (p, 3), (p, anchors)."""
    center = np.array([paper.center for paper in room.anchors])
    width, height = np.array([(paper.width, paper.height) for paper in room.anchors]).T
    smallest = _MIN_PAPER_PX if room.papers else _MIN_MARKER_PX
    normal = room.normals[room.nearest_wall(center[:, :2]), :2]
    way = eye[:, None, :2] - center[:, :2]
    reach = np.maximum(np.linalg.norm(way, axis=-1), 1e-6)
    cosine = np.sum(way * normal, -1) / reach
    rise = center[:, 2] - eye[:, None, 2]
    lowest, highest = config.elevations
    across = width * cosine * config.focal_px / reach
    along = height * config.focal_px / reach
    return np.asarray(
        (cosine > np.cos(_MAX_PAPER_INCIDENCE_RAD))
        & (rise + 0.5 * height < highest * reach)
        & (rise - 0.5 * height > lowest * reach)
        & (np.minimum(across, along) >= smallest)
        & room.visible(eye[:, None, :2], center[:, :2])
    )


def _on_arc(
    azimuth_rad: FloatArray, middle_rad: FloatArray, config: PlanConfig
) -> npt.NDArray[np.bool_]:
    """Whether azimuths (n, k) in map are within the arc of sweeps around `middle_rad` (n,)."""
    off = np.abs(wrap_rad(azimuth_rad - middle_rad[:, None]))
    return np.asarray(off <= config.half_arc_rad)


def band_share(
    range_m: FloatArray, eye_height_m: FloatArray | float, samples: WallSamples, config: PlanConfig
) -> FloatArray:
    """Share (..., s) of the textured band of heights that is in the image at a range."""
    low = min(config.texture_low_m, config.texture_high_m)
    high = np.minimum(max(config.texture_low_m, config.texture_high_m), samples.wall_height_m)
    lowest, highest = config.elevations
    top = np.minimum(eye_height_m + highest * range_m, high)
    bottom = np.maximum(eye_height_m + lowest * range_m, np.minimum(low, high - 0.1))
    return np.asarray(np.clip(top - bottom, 0.0, None) / np.maximum(high - low, 0.1))
