"""
Detection: landmarks re-mapped to how they should look now, found in the picture.

The plane of each patch and the expected pose give the template (Livatino and Madsen, section
2.1); it is drawn in the raw picture's own pixels, lens and all: nothing needs undistorting.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.patches import patch_axes, rays_to_patch
from landmark_nav.matching import blur_to, match_template
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

Float32Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class DetectionConfig:
    """How landmarks are searched and what counts as found."""

    min_size_px: int = parameter(
        14, 'least width and height of a template, pixels', minimum=6, maximum=256
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
    lens_sigma_px: float = parameter(
        0.05, 'what the lens model leaves, pixels', minimum=0, maximum=5
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
    refused: dict[int, Refusal] = {}
    found: list[tuple[int, float, float, float, FloatArray]] = []
    if len(indices):
        chosen = [landmark_map.landmarks[k] for k in indices]
        for landmark, expectation in zip(chosen, _expect(chosen, view, config), strict=True):
            outcome = _detect(landmark, expectation, view, config)
            if isinstance(outcome, Refusal):
                refused[landmark.id] = outcome
            else:
                found.append((landmark.id, *outcome))
    return DetectionResult(
        Detections(
            frame.stamp_ns,
            np.array([f[0] for f in found], dtype=np.int64),
            np.array([f[1] for f in found], dtype=np.float64),
            np.array([f[2] for f in found], dtype=np.float64),
            np.array([f[3] for f in found], dtype=np.float64),
            np.array([f[4] for f in found], dtype=np.float64).reshape(-1, 2),
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


@dataclass(frozen=True, eq=False)
class _Expectation:
    """Where a landmark should appear and how it maps to texels."""

    uv: FloatArray
    corners: FloatArray
    window: FloatArray
    ray_to_metres: FloatArray


def _expect(
    landmarks: Sequence[Landmark], view: _View, config: DetectionConfig
) -> list[_Expectation]:
    """Predict all landmarks at once."""
    position = np.array([k.position for k in landmarks])
    normal = np.array([k.normal for k in landmarks])
    half = np.array([(k.width_m, k.height_m) for k in landmarks]) / 2.0
    covariance = np.array([k.covariance for k in landmarks])
    right, down = patch_axes(normal)
    signs = np.array([[0.0, 0.0], [-1, -1], [1, -1], [1, 1], [-1, 1]])
    points = position[:, None] + (
        signs[:, :1] * half[:, None, :1] * right[:, None]
        + signs[:, 1:] * half[:, None, 1:] * down[:, None]
    )
    pixels = view.camera.project((points - view.center) @ view.rotation)

    # The prior's spread as pixels: across by the bearing, up and down by the range.
    d = position - view.center
    reach = np.hypot(d[:, 0], d[:, 1])
    from_base = position[:, :2] - view.prior.pose[:2]
    by_pose = np.stack([d[:, 1] / reach**2, -d[:, 0] / reach**2, -np.ones(len(d))], 1)
    across = by_pose[:, :2]
    bearing_var = np.einsum('ni,ij,nj->n', by_pose, view.prior.covariance, by_pose)
    bearing_var += np.einsum('ni,nij,nj->n', across, covariance[:, :2, :2], across)
    along = from_base / np.hypot(from_base[:, 0], from_base[:, 1])[:, None]
    range_var = np.einsum('ni,ij,nj->n', along, view.prior.covariance[:2, :2], along)
    range_var += np.einsum('ni,nij,nj->n', along, covariance[:, :2, :2], along)
    optical = d @ view.rotation
    stretch = 1.0 + (optical[:, 0] / optical[:, 2]) ** 2
    sigma_u = view.camera.fx * stretch * np.sqrt(bearing_var)
    rise = np.abs(d[:, 2] / reach)
    sigma_v = view.camera.fy * np.sqrt(
        rise**2 * range_var / reach**2 + covariance[:, 2, 2] / reach**2
    )
    # Turning by the bearing's error moves what is off the axis up and down as well.
    sigma_v += np.abs(optical[:, 0] / optical[:, 2]) * rise * sigma_u
    window = config.window_sigmas * np.stack(
        [sigma_u, np.hypot(sigma_v, config.vertical_sigma_px)], 1
    )
    window = np.clip(np.ceil(window + 2.0), 4, config.max_window_px)
    maps = rays_to_patch(position, normal, view.rotation, view.center)
    return [_Expectation(p[0], p[1:], w, h) for p, w, h in zip(pixels, window, maps, strict=True)]


def _detect(
    landmark: Landmark, expected: _Expectation, view: _View, config: DetectionConfig
) -> tuple[float, float, float, FloatArray] | Refusal:
    """Bearing, its variance, correlation and pixel of one landmark."""
    if not np.all(np.isfinite(expected.corners)):
        return Refusal('out of view')
    # The largest upright rectangle inside the patch's quadrilateral, cut by the picture.
    (u_tl, v_tl), (u_tr, v_tr), (u_br, v_br), (u_bl, v_bl) = expected.corners
    width, height = view.camera.width, view.camera.height
    left, right = int(np.ceil(max(u_tl, u_bl, 1.0))), int(min(u_tr, u_br, width - 2.0))
    top, bottom = int(np.ceil(max(v_tl, v_tr, 1.0))), int(min(v_bl, v_br, height - 2.0))
    size = (right - left + 1, bottom - top + 1)
    if min(size) < config.min_size_px:
        return Refusal('too small or cut off', f'{size[0]} x {size[1]} px')
    window_u, window_v = (int(w) for w in expected.window)
    x0, x1 = max(0, left - window_u), min(width, right + window_u + 1)
    y0, y1 = max(0, top - window_v), min(height, bottom + window_v + 1)

    template, pixel_texels = _render(landmark, expected.ray_to_metres, view, left, top, size)
    # A patch seen closer than it was learned is less sharp than the picture.
    search = blur_to(view.grey[y0:y1, x0:x1].astype(np.float32), pixel_texels**-1)
    match = match_template(
        search,
        template,
        min_score=landmark.threshold,
        max_second_ratio=config.max_second_ratio,
    )
    if isinstance(match, Refusal):
        return match
    expected_at = np.array([(left + right) / 2.0 - x0, (top + bottom) / 2.0 - y0])
    shift = match.xy - expected_at
    if abs(shift[1]) > expected.window[1]:
        return Refusal('wrong height', f'{shift[1]:.1f} px off')
    uv = expected.uv + shift
    bearing, by_uv = _bearing(landmark, uv, view)
    variance = float(by_uv @ (match.covariance + np.eye(2) * config.lens_sigma_px**2) @ by_uv)
    return bearing, variance, match.score, uv


def _render(
    landmark: Landmark,
    ray_to_metres: FloatArray,
    view: _View,
    left: int,
    top: int,
    size: tuple[int, int],
) -> tuple[Float32Image, FloatArray]:
    """The patch as the picture should show it, and texels a pixel across and down."""
    rays = view.camera.ray_grid[top : top + size[1], left : left + size[0]]
    texel_m = landmark.width_m / landmark.patch.shape[1]
    # Metres on the wall -> texels, in the same homography.
    to_texel = np.array(
        [
            [1.0 / texel_m, 0.0, (landmark.patch.shape[1] - 1) / 2.0],
            [0.0, 1.0 / texel_m, (landmark.patch.shape[0] - 1) / 2.0],
            [0.0, 0.0, 1.0],
        ]
    )
    h = (to_texel @ ray_to_metres).astype(np.float32)
    x, y = rays[..., 0], rays[..., 1]
    w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    column = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w
    row = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w
    texels = np.array(
        [
            abs(float(column[size[1] // 2, -1] - column[size[1] // 2, 0])) / (size[0] - 1),
            abs(float(row[-1, size[0] // 2] - row[0, size[0] // 2])) / (size[1] - 1),
        ]
    )
    texels = np.maximum(texels, 1e-2)
    patch = blur_to(landmark.patch.astype(np.float32), texels)
    template = cv2.remap(patch, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(template, dtype=np.float32), texels


def _bearing(landmark: Landmark, uv: FloatArray, view: _View) -> tuple[float, FloatArray]:
    """Bearing at the pan axis in the base frame, and its derivative by the pixel (2,)."""
    rays = view.camera.unproject(uv + np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]]))
    directions = rays @ view.rotation.T
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    by_uv = np.angle(np.exp(1j * (azimuth[1:] - azimuth[0]))) / 0.5
    # From the optical centre to the axis: exact if the range is, and the centre is close to it.
    reach = float(np.hypot(*(landmark.position - view.center)[:2]))
    point = view.center[:2] + reach * np.array([np.cos(azimuth[0]), np.sin(azimuth[0])])
    at_axis = point - view.axis
    bearing = np.arctan2(at_axis[1], at_axis[0]) - view.prior.pose[2]
    return float(np.angle(np.exp(1j * bearing))), by_uv
