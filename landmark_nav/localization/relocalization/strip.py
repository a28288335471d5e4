"""An image as detections are looked for in it: on an upright cylinder, shrunk."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.types import CameraFrame, FloatArray, ImageArray

__all__ = ['Strip']


class Strip:
    """An image on an upright cylinder around its optical centre."""

    def __init__(self, frame: CameraFrame, mount: PanTiltMount, resolution: float) -> None:
        turn, self.center = mount.camera_pose_base(frame.pan_rad, frame.tilt_rad, frame.roll_rad)
        camera = frame.camera
        border = np.linspace(0.0, 1.0, 9)
        size = [camera.width - 1.0, camera.height - 1.0]
        rays = camera.unproject(np.stack(np.meshgrid(border, border), -1) * size) @ turn.T
        self.middle = float(np.arctan2(turn[1, 2], turn[0, 2]))
        aside = self.aside(np.arctan2(rays[..., 1], rays[..., 0]))
        tangent = rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
        cylinder = Cylinder.with_resolution(
            resolution * camera.fx, float(tangent.min()), float(tangent.max())
        )
        self.px_per_rad = cylinder.fy
        columns = np.arange(int(np.ceil(np.ptp(aside) * cylinder.fx)) + 1)
        self.azimuth = self.middle + float(aside.max()) - columns / cylinder.fx
        self.tangent = cylinder.tangent(np.arange(cylinder.height))
        directions = np.empty((cylinder.height, len(columns), 3))
        directions[..., 0], directions[..., 1] = np.cos(self.azimuth), np.sin(self.azimuth)
        directions[..., 2] = self.tangent[:, None]
        self.image = _resampled(frame.image, camera.project(directions @ turn), resolution)

    def row_of(self, tangent: float) -> float:
        """Row of a tangent of elevation."""
        return float((self.tangent[0] - tangent) * self.px_per_rad)

    def aside(self, azimuth: FloatArray) -> FloatArray:
        """How far to the left of the middle azimuths are."""
        return np.asarray(wrap_rad(azimuth - self.middle))

    def columns(self, left: FloatArray, right: FloatArray) -> npt.NDArray[np.intp]:
        """First and end (2, n) of the columns between angles aside."""
        bounds = (self.azimuth[0] - self.middle - np.array([left, right])) * self.px_per_rad
        return np.asarray(np.clip(np.rint(bounds), 0, len(self.azimuth)), dtype=np.intp)


def _resampled(image: ImageArray, pixels: FloatArray, resolution: float) -> ImageArray:
    """Grey values at pixels (rows, columns, 2) of an image, after shrinking it."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    small = cv2.resize(grey, None, fx=resolution, fy=resolution, interpolation=cv2.INTER_AREA)
    at = np.nan_to_num((pixels + 0.5) * resolution - 0.5, nan=-1e4).astype(np.float32)
    return np.asarray(
        cv2.remap(
            small,
            at[..., 0],
            at[..., 1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=float(np.mean(small)),
        ),
        dtype=np.uint8,
    )
