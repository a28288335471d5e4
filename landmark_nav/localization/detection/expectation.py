"""Expected places of landmarks in an image, and the search windows around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.patches import rays_to_patch
from landmark_nav.parameters import Config
from landmark_nav.types import CameraFrame, FloatArray, LandmarkMap, PoseEstimate, Refusal


@dataclass(frozen=True)
class DetectionConfig(Config):
    """
    How landmarks are searched and what counts as found.

    docs/decisions.md (detection) compares values of `target_count`; the others are chosen by
    hand.
    """

    # Least width and height of a template, pixels.
    min_size_px: int = 14
    # Most landmarks searched in an image: the most informative ones.
    max_count: int = 16
    # Landmarks searched in an image while most of those in the last image were found: with more,
    # the errors of the map dominate.
    target_count: int = 8
    # Greatest score of a second peak, relative to the best.
    max_second_ratio: float = 0.9
    # Half width of the search window, in predicted sigmas.
    window_sigmas: float = 3.0
    # Largest half width of the search window, pixels.
    max_window_px: int = 80
    # Vertical sigma of matches by tilt and floor, pixels.
    vertical_sigma_px: float = 1.0
    # Sigma of the residual error of the lens model, pixels.
    lens_sigma_px: float = 0.03


# Least half width of a search window, pixels.
LEAST_WINDOW_PX = 4
# A pixel, and half a pixel right of it and below it, to differentiate the lens.
HALF_PIXEL = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
NOT_LOOKED_FOR = _OUT_OF_VIEW, _TOO_SMALL = 'out of view', 'too small or cut off'


class View:
    """The image, and the camera's pose by the prior."""

    def __init__(self, frame: CameraFrame, prior: PoseEstimate, mount: PanTiltMount) -> None:
        self.stamp_ns, self.camera = frame.stamp_ns, frame.camera
        image = frame.image
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        self.grey = np.asarray(grey, dtype=np.uint8)
        self.prior = prior
        self.rotation, self.center = mount.camera_pose_map(
            prior.pose, frame.pan_rad, frame.tilt_rad, frame.roll_rad
        )
        self.roll_rad = mount.camera_roll_rad + frame.roll_rad
        # Lower rows are exposed later: a turn that grows with the row, small and near the axis.
        right, down, _ = frame.row_turn_rad * self.rotation[2]
        self.shear = np.array([[1.0, -down, 0.0], [0.0, 1.0 + right, 0.0], [0.0, 0.0, 1.0]])
        self.axis = mount.axis_pose_map(prior.pose)[:2]


class Expectation(NamedTuple):
    """
    Expected pixel `uv` (2,) of a landmark's centre, and its template.

    `left`, `top`, `right`, `bottom` are the template's rectangle in the image, empty if nothing
    of the patch is in view; `window` (2,) is the half width and height of the search around it;
    `ray_to_patch` (3, 3) maps rays (x, y, 1) of the camera to metres on the patch.
    """

    uv: FloatArray
    left: int
    top: int
    right: int
    bottom: int
    window: tuple[int, int]
    ray_to_patch: FloatArray

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the template."""
        return self.right - self.left + 1, self.bottom - self.top + 1

    def refusal(self, least_px: int) -> Refusal | None:
        """Return why the landmark is not searched: out of view, too small; None if it is."""
        width, height = self.size
        if width <= 0 and height <= 0:
            return Refusal(_OUT_OF_VIEW)
        if min(width, height) < least_px:
            return Refusal(_TOO_SMALL, f'{width} x {height} px')
        return None


def expect(
    landmark_map: LandmarkMap, indices: npt.NDArray[np.intp], view: View, config: DetectionConfig
) -> list[Expectation]:
    """Expected places of the landmarks `indices` in a view."""
    if not len(indices):
        return []
    position, normal = landmark_map.positions[indices], landmark_map.normals[indices]
    points = np.concatenate([position[:, None], landmark_map.corners[indices]], axis=1)
    pixels = view.camera.project((points - view.center) @ view.rotation @ view.shear.T)
    # Left and upper sides first, also if the camera is upside down.
    u, v = np.sort(pixels[:, 1:], axis=1).transpose(2, 0, 1)
    width, height = view.camera.width, view.camera.height
    # The largest upright rectangle inside the patch's quadrilateral, cut by the image.
    low, high = [u[:, 1], v[:, 1]], [u[:, 2], v[:, 2]]
    most = np.array([[width - 2.0], [height - 2.0]])
    corners = np.array([np.ceil(np.maximum(low, 1.0)), np.floor(np.minimum(high, most))])
    # Points behind the camera have no pixels.
    corners[:, :, ~np.isfinite(pixels).all((1, 2))] = np.array([0.0, -1.0])[:, None, None]
    (left, top), (end_x, end_y) = corners.astype(int).tolist()
    window = _windows(position, landmark_map.covariances[indices], view, config)
    maps = rays_to_patch(position, normal, view.rotation, view.center) @ np.linalg.inv(view.shear)
    places = zip(pixels[:, 0], left, top, end_x, end_y, window, maps, strict=True)
    return [Expectation(*place) for place in places]


def _windows(
    position: FloatArray, covariance: FloatArray, view: View, config: DetectionConfig
) -> list[tuple[int, int]]:
    """Half widths and heights of the search windows, pixels, from the errors of prior and map."""
    d = position - view.center
    reach = np.hypot(d[:, 0], d[:, 1])
    from_base = position[:, :2] - view.prior.pose[:2]
    by_pose = np.array([d[:, 1] / reach**2, -d[:, 0] / reach**2, -np.ones(len(d))]).T
    own = covariance[:, :2, :2]
    bearing_var = quadratic(by_pose, view.prior.covariance) + quadratic(by_pose[:, :2], own)
    along = from_base / np.hypot(from_base[:, 0], from_base[:, 1])[:, None]
    range_var = quadratic(along, view.prior.covariance[:2, :2] + own)
    optical = d @ view.rotation
    aside = optical[:, 0] / optical[:, 2]
    sigma_u = view.camera.fx * (1.0 + aside**2) * np.sqrt(bearing_var)
    rise = np.abs(d[:, 2] / reach)
    sigma_v = view.camera.fy * np.sqrt(rise**2 * range_var + covariance[:, 2, 2]) / reach
    # Off the optical axis an error of the bearing also moves landmarks vertically.
    sigma_v += np.abs(aside) * rise * sigma_u
    sigmas = np.array([sigma_u, np.hypot(sigma_v, config.vertical_sigma_px)]).T
    half = np.ceil(config.window_sigmas * sigmas + 2.0)
    window = np.clip(half, LEAST_WINDOW_PX, config.max_window_px)
    return list(map(tuple, window.astype(int).tolist()))


def quadratic(rows: FloatArray, matrix: FloatArray) -> FloatArray:
    """Quadratic forms (n,) of rows (n, k) with a matrix (k, k) or one for each (n, k, k)."""
    return np.asarray(np.sum((rows[:, None] @ matrix)[:, 0] * rows, -1))
