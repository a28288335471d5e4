"""
Projection of frames on a cylinder, and the cylinder for a sweep.

Inverse mapping by Livatino and Madsen, section 2.2, but with the lens model and whole frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
import math

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.types import CameraFrame, FloatArray, ImageArray, Sweep

# Spacing of exact projections; the map is interpolated between them, with errors below 0.02 px.
_GRID_PX = 8

# Largest elevation of the camera; beyond it, it sees no walls.
_MAX_ELEVATION_DEG = 45.0

RangeOfAzimuth = Callable[[FloatArray], FloatArray]


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
    inside: npt.NDArray[np.uint8]

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
    range_m: RangeOfAzimuth | None = None,
    reach_rad: float = np.inf,
) -> FrameSlab:
    """
    Project one frame on a cylinder.

    Parameters
    ----------
    frame : CameraFrame
        BGR or grey; the slab has the same channels.
    range_m : callable, optional
        Horizontal distance of the scene at azimuths (n,) in the base frame.
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
        points = points * range_m(cylinder.azimuth_rad(columns))[:, None] - (center - axis)
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
        start, float(middle), np.asarray(image, dtype=np.uint8), np.asarray(inside, dtype=np.uint8)
    )


@lru_cache(maxsize=4)
def _border_rays(camera: CameraModel) -> FloatArray:
    """Rays (36, 3) along the border of the image; the same for a whole sweep."""
    right, bottom = camera.width - 1.0, camera.height - 1.0
    u, v = np.linspace(0.0, right, 9), np.linspace(0.0, bottom, 9)
    return camera.unproject(
        np.concatenate(
            [np.stack([u, u * 0], -1), np.stack([u, u * 0 + bottom], -1),
             np.stack([v * 0, v], -1), np.stack([v * 0 + right, v], -1)]
        )
    )  # fmt: skip
