"""
Panorama synthesis: the frames of a sweep are projected on one cylinder and blended.

Inverse mapping by Livatino and Madsen, section 2.2, but with the lens model and whole frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
import math

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import BoolArray, IndexArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.types import CameraFrame, FloatArray, ImageArray, Sweep

# Spacing of exact projections; the map is interpolated between them, with errors below 0.02 px.
_GRID_PX = 8
# Largest elevation of the camera; beyond it, it sees no walls.
_MAX_ELEVATION_DEG = 45.0

RangeOfRay = Callable[[FloatArray, FloatArray], FloatArray]
CountArray = npt.NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class FrameSlab:
    """
    One frame, projected on a cylinder.

    `image` starts at unwrapped column `start`; `inside` is 255 where the frame covers it and 0
    elsewhere, where the image is extrapolated. `middle` is the unwrapped column of its optical
    axis.
    """

    start: int
    middle: float
    image: ImageArray
    inside: ImageArray

    @property
    def width(self) -> int:
        """Number of columns."""
        return int(self.inside.shape[1])


def sweep_cylinder(sweep: Sweep, mount: PanTiltMount) -> Cylinder:
    """
    Cylinder with the vertical field of view of the middle columns of the frames.

    Raises `LandmarkNavError`: the camera looks so far up or down that it sees no walls, or the
    cylinder has too many pixels.
    """
    camera = sweep.frames[0].camera
    ends = camera.unproject([[camera.cx, 0.0], [camera.cx, camera.height - 1.0]])
    pan, tilt, roll = (
        np.array([getattr(frame, name) for frame in sweep.frames])
        for name in ('pan_rad', 'tilt_rad', 'roll_rad')
    )
    turned = mount.camera_pose_base(pan, tilt, roll)[0]
    _check_level(turned[:, 2, 2], pan)
    rays = np.einsum('kij,nj->kni', turned, ends)
    tangent = rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
    return Cylinder.with_resolution(camera.fx, float(tangent.min()), float(tangent.max()))


def _check_level(rise: FloatArray, pan_rad: FloatArray) -> None:
    """Raise `LandmarkNavError` if a frame looks too far up or down; `rise` (n,) are the sines."""
    worst = int(np.argmax(np.abs(rise)))
    elevation_deg = math.degrees(math.asin(rise[worst]))
    if abs(elevation_deg) > _MAX_ELEVATION_DEG:
        where = 'up' if elevation_deg > 0.0 else 'down'
        raise LandmarkNavError(
            f'the camera looks {abs(elevation_deg):.0f} deg {where} at pan {pan_rad[worst]:.2f} '
            f'rad, of {_MAX_ELEVATION_DEG:.0f} at most: check the tilt joint, and the rpy '
            'of pan_axis in robot.yaml'
        )


def grey_frame(frame: CameraFrame) -> CameraFrame:
    """Return a frame without its colours."""
    if frame.image.ndim == 2:
        return frame
    grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
    return replace(frame, image=np.asarray(grey, dtype=np.uint8))


def frame_slab(
    frame: CameraFrame,
    mount: PanTiltMount,
    cylinder: Cylinder,
    range_m: RangeOfRay | None = None,
    reach_rad: float = np.inf,
) -> FrameSlab:
    """
    Project one frame, BGR or grey, on a cylinder.

    Parameters
    ----------
    range_m : callable, optional
        Horizontal distance of the scene at azimuths (n,) in the base frame and tangents (m, n).
    reach_rad : float
        Largest angle from the optical axis at which the frame is used, to both sides.
    """
    camera = frame.camera
    rotation, center = mount.camera_pose_base(frame.pan_rad, frame.tilt_rad, frame.roll_rad)
    ahead = rotation[:, 2]
    middle = cylinder.cx - cylinder.fx * np.arctan2(ahead[1], ahead[0])

    # Azimuths of the border of the frame, relative to its central ray.
    rays = _border_rays(camera) @ rotation.T
    side = np.arctan2(
        ahead[0] * rays[:, 1] - ahead[1] * rays[:, 0],
        ahead[0] * rays[:, 0] + ahead[1] * rays[:, 1],
    )
    start = int(np.floor(middle - cylinder.fx * min(float(side.max()), reach_rad)))
    end = int(np.ceil(middle - cylinder.fx * max(float(side.min()), -reach_rad)))
    count = end - start + 1

    # Exact projections on a coarse grid; cv2.resize interpolates between them.
    cells = (-(-cylinder.height // _GRID_PX) + 2, -(-count // _GRID_PX) + 2)
    rows = (np.arange(cells[0]) - 0.5) * _GRID_PX - 0.5
    columns = start + (np.arange(cells[1]) - 0.5) * _GRID_PX - 0.5
    points = cylinder.rays(np.stack(np.meshgrid(columns, rows), -1))
    if range_m is not None:
        # A leaning axis moves the optical centre up and down.
        opposite = mount.camera_pose_base(frame.pan_rad + np.pi, frame.tilt_rad)[1]
        axis = np.array([*mount.axis_xyz[:2], 0.5 * (center[2] + opposite[2])])
        reach_m = range_m(cylinder.azimuth_rad(columns), points[..., 2])
        points = points * reach_m[..., None] - (center - axis)
    grid = camera.project(points @ rotation).astype(np.float32)
    size = (cells[1] * _GRID_PX, cells[0] * _GRID_PX)
    window = (slice(_GRID_PX, _GRID_PX + cylinder.height), slice(_GRID_PX, _GRID_PX + count))
    pixels = cv2.resize(grid, size, interpolation=cv2.INTER_LINEAR)[window]
    inside = cv2.inRange(pixels, (0.0, 0.0), (camera.width - 1.0, camera.height - 1.0))
    # Cells that touch the part that the lens cannot see are NaN, which `inRange` excludes.
    cv2.patchNaNs(pixels, -1.0)
    # One map of both coordinates: splitting it would take as long as the remapping.
    image = cv2.remap(  # type: ignore[call-overload]
        frame.image, pixels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return FrameSlab(
        start, float(middle), np.asarray(image, np.uint8), np.asarray(inside, np.uint8)
    )


@lru_cache(maxsize=4)
def _border_rays(camera: CameraModel) -> FloatArray:
    """Rays (36, 3) along the border of the image; the same for a whole sweep."""
    right, bottom = camera.width - 1.0, camera.height - 1.0
    u, v, none = np.linspace(0.0, right, 9), np.linspace(0.0, bottom, 9), np.zeros(9)
    sides = (u, none), (u, none + bottom), (none, v), (none + right, v)
    return camera.unproject(np.concatenate([np.stack(side, -1) for side in sides]))


# Neighbour to both sides up to which a frame is used: each pixel is then covered by eight frames
# (seven in the paper), or four, if they are feathered.
_OF_MEDIAN, _OF_FEATHER = 4, 2
# Smallest number of frames for a median; pixels covered by fewer are feathered.
_MIN_FOR_MEDIAN = 3


@dataclass(frozen=True, eq=False)
class CylinderImage:
    """A panorama without pose: BGR image, mask of covered pixels, geometry."""

    image: ImageArray
    mask: BoolArray
    cylinder: Cylinder


def synthesize_cylinder(
    sweep: Sweep,
    mount: PanTiltMount,
    range_m: RangeOfRay | None = None,
    feathered: bool = False,
) -> CylinderImage:
    """
    Project the frames of a sweep on one cylinder around the pan axis.

    A pixel is the median of the frames that cover it, feathered where they are fewer than three.

    Parameters
    ----------
    range_m : callable, optional
        Horizontal distance of the scene at azimuths (n,) in the base frame and tangents (m, n) of
        elevations. It corrects the parallax between frames if the optical centre is off the axis.
    feathered : bool
        Whether all pixels are feathered, which is faster.
    """
    cylinder = sweep_cylinder(sweep, mount)
    reach = _reach_rad(sweep, _OF_FEATHER if feathered else _OF_MEDIAN)
    slabs = [
        frame_slab(frame, mount, cylinder, range_m, float(far))
        for frame, far in zip(sweep.frames, reach, strict=True)
    ]
    count = np.zeros((cylinder.height, cylinder.width), np.uint16)
    for slab in slabs:
        for columns, part in _wrapped(slab.start, slab.width, cylinder.width):
            count[:, columns] += slab.inside[:, part] & 1
    if feathered:
        image = _feather(slabs, reach, cylinder, np.arange(cylinder.height))
    else:
        image = _median(slabs, count)
        few = (count > 0) & (count < _MIN_FOR_MEDIAN)
        rows = np.flatnonzero(few.any(axis=1))
        if len(rows):
            image[few] = _feather(slabs, reach, cylinder, rows)[few[rows]]
    if image.shape[2] == 1:
        image = np.repeat(image, 3, axis=2)
    return CylinderImage(image, count > 0, cylinder)


def _reach_rad(sweep: Sweep, neighbours: int) -> FloatArray:
    """Largest angle (n,) from the axis at which frames are used: to a neighbour on both sides."""
    # Frames of different tilts may not cover the same elevations; then all of each is used.
    tilt = np.array([frame.tilt_rad for frame in sweep.frames])
    if len(tilt) <= 2 * neighbours or np.ptp(tilt) > 0.02:
        return np.full(len(tilt), np.inf)
    pan = np.array([frame.pan_rad for frame in sweep.frames])
    away = np.mod(pan[:, None] - pan, 2.0 * np.pi)
    sides = np.stack([away, away.T])
    # Frames at the same azimuth, such as on a second turn, do not count as neighbours.
    sides[np.minimum(sides, 2.0 * np.pi - sides) < 1e-2] = np.inf
    return np.asarray(np.sort(sides, axis=2)[..., neighbours - 1].max(axis=0))


def _wrapped(start: int, count: int, width: int) -> list[tuple[slice, slice]]:
    """Split unwrapped columns [start, start + count) at the seam: (in panorama, in slab)."""
    pieces = []
    for first, last in pairwise([0, *range(width - start % width, count, width), count]):
        column = (start + first) % width
        pieces.append((slice(column, column + last - first), slice(first, last)))
    return pieces


def _feather(
    slabs: list[FrameSlab], reach_rad: FloatArray, cylinder: Cylinder, rows: IndexArray
) -> ImageArray:
    """Weighted mean in some rows; the weight of a frame falls with the angle from its axis."""
    channels = slabs[0].image.shape[2:]
    total = np.zeros((len(rows), cylinder.width, *channels), np.float32)
    weights = np.zeros((len(rows), cylinder.width), np.float32)
    for slab, far in zip(slabs, reach_rad, strict=True):
        off = np.abs(slab.start + np.arange(slab.width) - slab.middle)
        share = np.minimum(off / (min(cylinder.fx * far, slab.width / 2.0) + 1.0), 1.0)
        window = (np.cos(np.pi / 2.0 * share) ** 2 + 1e-3).astype(np.float32)
        weight = window * (slab.inside[rows] & 1)
        wide = cv2.merge([weight] * 3) if channels else weight
        weighted = cv2.multiply(slab.image[rows], wide, dtype=cv2.CV_32F)
        for columns, part in _wrapped(slab.start, slab.width, cylinder.width):
            total[:, columns] += weighted[:, part]
            weights[:, columns] += weight[:, part]
    mean = np.atleast_3d(total) / np.maximum(weights, 1e-6)[..., None]
    return np.asarray(mean + np.float32(0.5)).astype(np.uint8)


def _median(slabs: list[FrameSlab], count: CountArray) -> ImageArray:
    """Median over the frames that cover a pixel."""
    width = count.shape[1]
    for slab in slabs:
        # Uncovered pixels are set to 255, so that they sort behind all others.
        channels = slab.image.size // slab.inside.size
        outside = cv2.merge([cv2.bitwise_not(slab.inside)] * channels)
        cv2.bitwise_or(slab.image, outside, dst=slab.image)
    image = np.zeros((*count.shape, *slabs[0].image.shape[2:]), np.uint8)
    cuts = sorted({c % width for s in slabs for c in (s.start, s.start + s.width)} | {0})
    for left, right in pairwise([*cuts, width]):
        layers = []
        for slab in slabs:
            offset = (left - slab.start) % width
            # A slab wider than the turn contains a column twice.
            for first in range(offset, slab.width - (right - left) + 1, width):
                layers.append(np.ascontiguousarray(slab.image[:, first : first + right - left]))
        if layers:
            image[:, left:right] = _middle(layers, count[:, left:right])
    return np.atleast_3d(image)


def _middle(values: list[ImageArray], count: CountArray) -> ImageArray:
    """Median of the `count` smallest values of each pixel, by sorting their lower half."""
    total = len(values)
    half = total // 2
    for i in range(half + 1):
        for j in range(total - 1, i, -1):
            low = np.minimum(values[j - 1], values[j])
            values[j] = np.maximum(values[j - 1], values[j])
            values[j - 1] = low
    middle = _halfway(values[(total - 1) // 2], values[half])
    partly = np.nonzero((count < total) & (count > 0))
    if len(partly[0]):
        seen = count[partly].astype(np.intp)
        lower = np.stack(values[: half + 1])
        row, column = partly
        below, above = lower[(seen - 1) // 2, row, column], lower[seen // 2, row, column]
        middle[partly] = _halfway(below, above)
    return middle


def _halfway(below: ImageArray, above: ImageArray) -> ImageArray:
    """Mean of two images; `above` is not smaller, so that the difference fits a byte."""
    return np.asarray(above - (above - below) // 2, dtype=np.uint8)
