"""
Detection: landmarks re-mapped to how they should look now, found in the picture.

The plane of each patch and the expected pose give the template (Livatino and Madsen, section
2.1); it is drawn in the raw picture's own pixels, lens and all: nothing needs undistorting.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.patches import patch_axes, rays_to_patch
from landmark_nav.localization.detection.appearance import APPEARANCES, draw
from landmark_nav.matching import blur_sigmas, blur_to, Match, match_template
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import (
    CameraFrame,
    Detections,
    FloatArray,
    Landmark,
    LandmarkMap,
    PoseEstimate,
    Refusal,
)

__all__ = ['DetectionConfig', 'DetectionResult', 'camera_in_map', 'detect_landmarks']

# The centre of a patch and its corners, clockwise from the upper left.
_CORNERS = np.array([[0.0, 0.0], [-1, -1], [1, -1], [1, 1], [-1, 1]])
_HALF_PIXEL = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])


@dataclass(frozen=True)
class DetectionConfig:
    """How landmarks are searched and what counts as found."""

    min_size_px: int = parameter(
        14, 'least width and height of a template, pixels', minimum=6, maximum=256
    )
    max_count: int = parameter(
        16, 'most landmarks looked for in a picture: those that tell most', minimum=3, maximum=1000
    )
    max_second_ratio: float = parameter(
        0.9, 'greatest share of the peak that another place may reach', minimum=0, maximum=1
    )
    window_sigmas: float = parameter(
        3.0, 'half width of the search in predicted standard deviations', minimum=1, maximum=6
    )
    max_window_px: int = parameter(
        80, 'largest half width of the search, pixels', minimum=4, maximum=2000
    )
    vertical_sigma_px: float = parameter(
        1.0, 'vertical error of the picture from tilt and floor', minimum=0.1, maximum=50
    )
    appearance: str = parameter(
        'virtual_view',
        'what is looked for: the patch as it was learned, or a view from here out of all '
        'panoramas that saw it',
        choices=APPEARANCES,
    )
    lens_sigma_px: float = parameter(
        0.03, 'what the lens model leaves, pixels', minimum=0, maximum=5
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_parameters(self)


@dataclass(frozen=True, eq=False)
class DetectionResult:
    """Landmarks found, and why the others were not, by id."""

    detections: Detections
    refused: Mapping[int, Refusal]


def camera_in_map(
    pose_map_base: FloatArray, mount: PanTiltMount, pan_rad: float, tilt_rad: float
) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) optical -> map and optical centre (3,) in map."""
    rotation, center = mount.camera_pose_base(pan_rad, tilt_rad)
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(pose_map_base[2])
    return turn @ rotation, turn @ center + [pose_map_base[0], pose_map_base[1], 0.0]


def detect_landmarks(
    frame: CameraFrame,
    prior: PoseEstimate,
    landmark_map: LandmarkMap,
    mount: PanTiltMount,
    config: DetectionConfig,
    indices: npt.NDArray[np.intp],
) -> DetectionResult:
    """
    Find landmarks in a picture.

    Parameters
    ----------
    frame : CameraFrame
        Picture with the joint angles at its stamp.
    prior : PoseEstimate
        Expected pose of the base at its stamp.
    landmark_map : LandmarkMap
        What was learned.
    mount : PanTiltMount
        Where the camera turns.
    config : DetectionConfig
        Parameters.
    indices : ndarray of int, shape (n,)
        Which landmarks of the map to look for: those expected in this view.

    Returns
    -------
    DetectionResult

    """
    view = _View(frame, prior, mount)
    chosen = [landmark_map.landmarks[k] for k in indices]
    refused: dict[int, Refusal] = {}
    found: list[tuple[Landmark, FloatArray, Match]] = []
    for landmark, expected in zip(
        chosen, _expect(landmark_map, indices, view, config), strict=True
    ):
        match = _detect(landmark, expected, view, config)
        if isinstance(match, Refusal):
            refused[landmark.id] = match
        else:
            found.append((landmark, *match))
    uv = np.array([f[1] for f in found]).reshape(-1, 2)
    covariance = np.array([f[2].covariance for f in found]).reshape(-1, 2, 2)
    bearing, variance = _bearings([f[0] for f in found], uv, covariance, view, config)
    return DetectionResult(
        Detections(
            frame.stamp_ns,
            np.array([f[0].id for f in found], dtype=np.int64),
            bearing,
            variance,
            np.array([f[2].score for f in found], dtype=np.float64),
            uv,
        ),
        refused,
    )


class _View:
    """The picture with the camera where the prior puts it."""

    def __init__(self, frame: CameraFrame, prior: PoseEstimate, mount: PanTiltMount) -> None:
        self.camera: CameraModel = frame.camera
        image = frame.image
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        self.grey = np.asarray(grey, dtype=np.uint8)
        self.prior = prior
        self.rotation, self.center = camera_in_map(
            prior.pose, mount, frame.pan_rad, frame.tilt_rad
        )
        self.axis = se2.compose(prior.pose, [*mount.axis_xyz[:2], 0.0])[:2]


class _Expectation(NamedTuple):
    """
    Where a landmark should appear: `uv` (2,), pixels.

    `left`, `top`, `right`, `bottom` are the template's rectangle in the picture, empty if nothing
    of the patch is in view; `window` (2,) the half width and height of the search around it;
    `ray_to_patch` (3, 3) maps rays (x, y, 1) of the camera to metres on the patch.
    """

    uv: FloatArray
    left: int
    top: int
    right: int
    bottom: int
    window: tuple[int, int]
    ray_to_patch: FloatArray


def _expect(
    landmark_map: LandmarkMap,
    indices: npt.NDArray[np.intp],
    view: _View,
    config: DetectionConfig,
) -> list[_Expectation]:
    """Predict all landmarks at once."""
    if not len(indices):
        return []
    position, normal = landmark_map.positions[indices], landmark_map.normals[indices]
    half = 0.5 * landmark_map.sizes_m[indices]
    right, down = patch_axes(normal)
    points = position[:, None] + (
        _CORNERS[:, :1] * half[:, None, :1] * right[:, None]
        + _CORNERS[:, 1:] * half[:, None, 1:] * down[:, None]
    )
    pixels = view.camera.project((points - view.center) @ view.rotation)
    # Left and upper sides first, also where the camera hangs upside down.
    u, v = np.sort(pixels[:, 1:], axis=1).transpose(2, 0, 1)
    width, height = view.camera.width, view.camera.height
    # The largest upright rectangle inside the patch's quadrilateral, cut by the picture.
    low, high = [u[:, 1], v[:, 1]], [u[:, 2], v[:, 2]]
    corners = np.stack(
        [
            np.ceil(np.maximum(low, 1.0)),
            np.floor(np.minimum(high, np.array([[width - 2.0], [height - 2.0]]))),
        ]
    )
    # What is behind the camera has no pixels.
    corners[:, :, ~np.isfinite(pixels).all((1, 2))] = np.array([0.0, -1.0])[:, None, None]
    (left, top), (end_x, end_y) = corners.astype(int).tolist()
    window = _windows(position, landmark_map.covariances[indices], view, config)
    maps = rays_to_patch(position, normal, view.rotation, view.center)
    places = zip(pixels[:, 0], left, top, end_x, end_y, window, maps, strict=True)
    return [_Expectation(*place) for place in places]


def _windows(
    position: FloatArray, covariance: FloatArray, view: _View, config: DetectionConfig
) -> list[tuple[int, int]]:
    """Half width and height of the search: what prior and map leave open, as pixels."""
    d = position - view.center
    reach = np.hypot(d[:, 0], d[:, 1])
    from_base = position[:, :2] - view.prior.pose[:2]
    by_pose = np.stack([d[:, 1] / reach**2, -d[:, 0] / reach**2, -np.ones(len(d))], 1)
    across = by_pose[:, :2]
    bearing_var = _quadratic(by_pose, view.prior.covariance)
    bearing_var += _quadratic(across, covariance[:, :2, :2])
    along = from_base / np.hypot(from_base[:, 0], from_base[:, 1])[:, None]
    range_var = _quadratic(along, view.prior.covariance[:2, :2])
    range_var += _quadratic(along, covariance[:, :2, :2])
    optical = d @ view.rotation
    aside = optical[:, 0] / optical[:, 2]
    sigma_u = view.camera.fx * (1.0 + aside**2) * np.sqrt(bearing_var)
    rise = np.abs(d[:, 2] / reach)
    sigma_v = view.camera.fy * np.sqrt(
        rise**2 * range_var / reach**2 + covariance[:, 2, 2] / reach**2
    )
    # Turning by the bearing's error moves what is off the axis up and down as well.
    sigma_v += np.abs(aside) * rise * sigma_u
    window = config.window_sigmas * np.stack(
        [sigma_u, np.hypot(sigma_v, config.vertical_sigma_px)], 1
    )
    window = np.clip(np.ceil(window + 2.0), 4, config.max_window_px)
    return [(int(u), int(v)) for u, v in window.tolist()]


def _quadratic(rows: FloatArray, matrix: FloatArray) -> FloatArray:
    """Variance (n,) along rows (n, k) of one matrix or of one each, (k, k) or (n, k, k)."""
    return np.asarray(np.sum((rows[:, None] @ matrix)[:, 0] * rows, -1))


def _detect(
    landmark: Landmark, expected: _Expectation, view: _View, config: DetectionConfig
) -> tuple[FloatArray, Match] | Refusal:
    """Pixel (2,) of the landmark's centre, and how its template was found."""
    _, left, top, right, bottom, (window_u, window_v), ray_to_patch = expected
    size = (right - left + 1, bottom - top + 1)
    if right < left and bottom < top:
        return Refusal('out of view')
    if min(size) < config.min_size_px:
        return Refusal('too small or cut off', f'{size[0]} x {size[1]} px')
    x0, x1 = max(0, left - window_u), min(view.camera.width, right + window_u + 1)
    y0, y1 = max(0, top - window_v), min(view.camera.height, bottom + window_v + 1)
    rays = view.camera.ray_grid[top : bottom + 1, left : right + 1]
    template, finer = draw(landmark, view.center, rays, ray_to_patch, config.appearance)
    # Where the picture shows more than the panoramas did, it is blurred to what they showed.
    search = blur_to(view.grey[y0:y1, x0:x1].astype(np.float32), finer)
    match = match_template(
        search,
        template,
        min_score=landmark.threshold,
        max_second_ratio=config.max_second_ratio,
        search_blur=blur_sigmas(finer),
    )
    if isinstance(match, Refusal):
        return match
    shift = match.xy - ((left + right) / 2.0 - x0, (top + bottom) / 2.0 - y0)
    if abs(shift[1]) > window_v:
        return Refusal('wrong height', f'{shift[1]:.1f} px off')
    return expected.uv + shift, match


def _bearings(
    landmarks: Sequence[Landmark],
    uv: FloatArray,
    covariance: FloatArray,
    view: _View,
    config: DetectionConfig,
) -> tuple[FloatArray, FloatArray]:
    """Bearings (n,) at the pan axis in the base frame, and their variances (n,)."""
    if not landmarks:
        return np.empty(0), np.empty(0)
    rays = view.camera.unproject(uv[:, None] + _HALF_PIXEL)
    directions = rays @ view.rotation.T
    azimuth = np.arctan2(directions[..., 1], directions[..., 0])
    by_uv = 2.0 * wrap_rad(azimuth[:, 1:] - azimuth[:, :1])
    # From the optical centre to the axis: exact if the range is, and the centre is close to it.
    position = np.array([k.position[:2] for k in landmarks])
    reach = np.hypot(*(position - view.center[:2]).T)
    toward = np.stack([np.cos(azimuth[:, 0]), np.sin(azimuth[:, 0])], -1)
    at_axis = view.center[:2] + reach[:, None] * toward - view.axis
    bearing = wrap_rad(np.arctan2(at_axis[:, 1], at_axis[:, 0]) - view.prior.pose[2])
    return bearing, _quadratic(by_uv, covariance + np.eye(2) * config.lens_sigma_px**2)
