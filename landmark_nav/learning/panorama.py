"""
Panorama synthesis: every pixel of the cylinder is looked up in the frames that cover it.

Inverse mapping after Livatino and Madsen, section 2.2; the full frames are used with their lens
model, or the paper's central crop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import CameraFrame, FloatArray, ImageArray, Sweep

__all__ = [
    'CylinderImage',
    'FrameSlab',
    'PanoramaConfig',
    'frame_slab',
    'sweep_cylinder',
    'synthesize_cylinder',
]

# Spacing of the exact projections; the map between them is interpolated, within 0.02 px.
_GRID_PX = 8

RangeOfAzimuth = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class PanoramaConfig:
    """How frames become a panorama."""

    blend: str = parameter(
        'median',
        'mean weighs all frames alike, feather favours the centre of each, median takes the '
        'middle where three frames or more cover a pixel, else it feathers',
        choices=('mean', 'median', 'feather'),
    )
    crop_px: int = parameter(
        0, 'side of the central square used of each frame; 0 uses all', minimum=0, maximum=8192
    )
    px_per_rad: float = parameter(
        0.0, "columns per radian; 0 takes the camera's focal length", minimum=0.0, maximum=8192.0
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_parameters(self)


@dataclass(frozen=True, eq=False)
class CylinderImage:
    """A panorama before its place is known: BGR image, mask of covered pixels, geometry."""

    image: ImageArray
    mask: npt.NDArray[np.bool_]
    cylinder: Cylinder


@dataclass(frozen=True, eq=False)
class FrameSlab:
    """What one frame contributes: `image` and `weight` from unwrapped column `start` on."""

    start: int
    image: ImageArray
    weight: npt.NDArray[np.float32]


def synthesize_cylinder(
    sweep: Sweep,
    mount: PanTiltMount,
    config: PanoramaConfig,
    range_m: RangeOfAzimuth | None = None,
) -> CylinderImage:
    """
    Project the frames of a sweep on one cylinder around the pan axis.

    Parameters
    ----------
    sweep : Sweep
        Frames with their joint angles.
    mount : PanTiltMount
        Where the optical centre turns.
    config : PanoramaConfig
        Blending and resolution.
    range_m : callable, optional
        Horizontal distance of what is seen at azimuths (n,) in the base frame. It matters only
        if the optical centre lies off the axis: each frame then sees the room from elsewhere.

    Returns
    -------
    CylinderImage

    """
    cylinder = sweep_cylinder(sweep, mount, config)
    slabs = [frame_slab(frame, mount, cylinder, config, range_m) for frame in sweep.frames]
    total = np.zeros((cylinder.height, cylinder.width, 3), np.float32)
    weight = np.zeros((cylinder.height, cylinder.width), np.float32)
    for slab in slabs:
        weighted = cv2.multiply(slab.image, cv2.merge([slab.weight] * 3), dtype=cv2.CV_32F)
        for columns, part in _wrapped(slab.start, slab.weight.shape[1], cylinder.width):
            total[:, columns] += weighted[:, part]
            weight[:, columns] += slab.weight[:, part]
    mask = weight > 1e-3
    mean = np.clip(np.rint(total / np.maximum(weight, 1e-3)[..., None]), 0, 255)
    image = mean.astype(np.uint8)
    if config.blend == 'median':
        image = _median(slabs, image, cylinder)
    return CylinderImage(image, mask, cylinder)


def sweep_cylinder(sweep: Sweep, mount: PanTiltMount, config: PanoramaConfig) -> Cylinder:
    """Cylinder as high as the middle columns of the frames see."""
    camera = sweep.frames[0].camera
    half = _half_window(sweep.frames[0], config)[1]
    ends = camera.unproject(
        [
            [camera.cx, max(camera.cy - half, 0.0)],
            [camera.cx, min(camera.cy + half, camera.height - 1.0)],
        ]
    )
    pan = np.array([frame.pan_rad for frame in sweep.frames])
    tilt = np.array([frame.tilt_rad for frame in sweep.frames])
    rays = np.einsum('kij,nj->kni', mount.camera_pose_base(pan, tilt)[0], ends)
    tangent = rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
    return Cylinder.with_resolution(
        config.px_per_rad or camera.fx, float(tangent.min()), float(tangent.max())
    )


def _half_window(frame: CameraFrame, config: PanoramaConfig) -> tuple[float, float]:
    """Half width and height of the part of the frame that is used, pixels."""
    if config.crop_px:
        return config.crop_px / 2.0, config.crop_px / 2.0
    return float(frame.camera.width), float(frame.camera.height)


def frame_slab(
    frame: CameraFrame,
    mount: PanTiltMount,
    cylinder: Cylinder,
    config: PanoramaConfig,
    range_m: RangeOfAzimuth | None,
) -> FrameSlab:
    """Project one frame on the cylinder; arguments as of `synthesize_cylinder`."""
    camera = frame.camera
    rotation, center = mount.camera_pose_base(frame.pan_rad, frame.tilt_rad, frame.roll_rad)
    half_u, half_v = _half_window(frame, config)
    left = max(camera.cx - half_u, 0.0)
    right = min(camera.cx + half_u, camera.width - 1.0)
    top = max(camera.cy - half_v, 0.0)
    bottom = min(camera.cy + half_v, camera.height - 1.0)

    # Columns that the frame's border reaches, counted from its central ray.
    u, v = np.linspace(left, right, 9), np.linspace(top, bottom, 9)
    border = np.concatenate(
        [np.stack([u, u * 0 + top], -1), np.stack([u, u * 0 + bottom], -1),
         np.stack([v * 0 + left, v], -1), np.stack([v * 0 + right, v], -1)]
    )  # fmt: skip
    rays = camera.unproject(border) @ rotation.T
    ahead = rotation[:, 2]
    side = np.arctan2(
        ahead[0] * rays[:, 1] - ahead[1] * rays[:, 0],
        ahead[0] * rays[:, 0] + ahead[1] * rays[:, 1],
    )
    middle = cylinder.cx - cylinder.fx * np.arctan2(ahead[1], ahead[0])
    start = int(np.floor(middle - cylinder.fx * side.max()))
    count = int(np.ceil(middle - cylinder.fx * side.min())) - start + 1

    # Exact projections on a coarse grid whose cells cv2.resize then interpolates.
    cells = (-(-cylinder.height // _GRID_PX) + 2, -(-count // _GRID_PX) + 2)
    rows = (np.arange(cells[0]) - 0.5) * _GRID_PX - 0.5
    columns = start + (np.arange(cells[1]) - 0.5) * _GRID_PX - 0.5
    azimuth = cylinder.azimuth_rad(columns)
    distance = np.ones_like(azimuth) if range_m is None else range_m(azimuth)
    grid = cylinder.rays(np.stack(np.meshgrid(columns, rows), -1)) * distance[:, None]
    axis = np.array([mount.axis_xyz[0], mount.axis_xyz[1], center[2]])
    offset = center - axis if range_m is not None else 0.0
    projected = camera.project((grid - offset) @ rotation).astype(np.float32)
    # A cell with a corner that can't be seen has no map at all, not one towards a made-up corner.
    visible = np.isfinite(projected[..., 0]).astype(np.float32)
    layers = np.dstack([np.nan_to_num(projected), visible])
    size = (cells[1] * _GRID_PX, cells[0] * _GRID_PX)
    fine = cv2.resize(layers, size, interpolation=cv2.INTER_LINEAR)
    fine = fine[_GRID_PX : _GRID_PX + cylinder.height, _GRID_PX : _GRID_PX + count]

    map_u, map_v, seen = cv2.split(fine)
    image = frame.image if frame.image.ndim == 3 else cv2.merge([frame.image] * 3)
    warped = cv2.remap(image, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = (map_u >= left) & (map_u <= right) & (map_v >= top) & (map_v <= bottom)
    inside &= seen > 0.999
    if config.blend != 'mean':
        window = np.cos(np.pi * (map_u - (left + right) / 2.0) / (right - left)) ** 4 + 1e-3
        weight = np.where(inside, window, 0.0).astype(np.float32)
    else:
        weight = inside.astype(np.float32)
    return FrameSlab(start, warped.astype(np.uint8, copy=False), weight)


def _wrapped(start: int, count: int, width: int) -> list[tuple[slice, slice]]:
    """Split unwrapped columns [start, start + count) at the seam: (in panorama, in slab)."""
    pieces = []
    done = 0
    while done < count:
        column = (start + done) % width
        size = min(count - done, width - column)
        pieces.append((slice(column, column + size), slice(done, done + size)))
        done += size
    return pieces


def _median(slabs: list[FrameSlab], mean: ImageArray, cylinder: Cylinder) -> ImageArray:
    """Median over the frames of each pixel; where one sees nothing, their mean stands in."""
    cuts = sorted(
        {c % cylinder.width for s in slabs for c in (s.start, s.start + s.weight.shape[1])}
    )
    image: ImageArray = mean.copy()
    edges = [*cuts, cuts[0] + cylinder.width]
    for left, right in pairwise(edges):
        layers = []
        for slab in slabs:
            offset = (left - slab.start) % cylinder.width
            if offset + right - left <= slab.weight.shape[1]:
                part = slice(offset, offset + right - left)
                layers.append((slab.image[:, part], slab.weight[:, part]))
        if len(layers) < 3:
            continue
        for columns, part in _wrapped(left, right - left, cylinder.width):
            stack = [
                np.where(weight[:, part, None] > 0.0, layer[:, part], mean[:, columns])
                for layer, weight in layers
            ]
            image[:, columns] = _middle(stack)
    return image


def _middle(stack: list[ImageArray]) -> ImageArray:
    """Median of a few images by partial sorting with vector minima and maxima."""
    values = list(stack)
    half = len(values) // 2
    for i in range(half + 1):
        for j in range(len(values) - 1, i, -1):
            low = np.minimum(values[j - 1], values[j])
            values[j] = np.maximum(values[j - 1], values[j])
            values[j - 1] = low
    if len(values) % 2:
        return np.asarray(values[half], dtype=np.uint8)
    below, above = values[half - 1], values[half]
    # Half the difference fits a byte; one more than the difference may not.
    return np.asarray(above - (above - below) // 2, dtype=np.uint8)
