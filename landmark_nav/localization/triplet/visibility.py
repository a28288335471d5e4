"""Which landmarks look as learned from a place, and which of them are whole in a view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.patches import observed_well
from landmark_nav.localization.triplet.ranking import LandmarkVisibility
from landmark_nav.parameters import Config, parameter
from landmark_nav.types import FloatArray, LandmarkMap, PoseEstimate


@dataclass(frozen=True)
class TripletConfig(Config):
    """
    Which landmarks count as visible, and how a triplet is rated.

    docs/decisions.md (where to look) compares ways to choose; the numbers are chosen by hand.
    """

    # Expected measurement sigma of a bearing, rad.
    bearing_sigma_rad: float = 4e-4
    # Least sampling of a patch relative to its reference view.
    min_sampling: float = 0.5
    # Greatest sampling relative to the reference view. Livatino and Madsen allow 2; here the image
    # is blurred to the resolution of the patch, which allows nearer views.
    max_sampling: float = 4.0
    # Least distance, m.
    min_range_m: float = 0.5
    max_range_m: float = parameter(
        12.0, 'greatest distance of a landmark that is looked at', minimum=0.1, maximum=1000.0
    )
    # Border of the image that a patch must not touch, pixels.
    border_px: float = 4.0
    # Margin of a patch to the edge of the view, in sigmas of the predicted bearing.
    margin_sigmas: float = 3.0
    # Relative improvement for which a new triplet replaces the one looked at.
    hysteresis: float = 0.3
    # Time of a look, s; the time of turning is weighed against it.
    dwell_time_s: float = 1.0
    # Rate of the pan unit, rad/s.
    pan_rate_rad_s: float = 1.0
    # Acceleration of the pan unit, rad/s^2.
    pan_acceleration_rad_s2: float = 8.0
    # Worst position sigma (root of the trace) worth a look, m.
    max_sigma_m: float = 0.5


def visible_landmarks(
    prior: PoseEstimate,
    landmark_map: LandmarkMap,
    camera: CameraModel,
    mount: PanTiltMount,
    pan_rad: float,
    tilt_rad: float,
    config: TripletConfig,
) -> npt.NDArray[np.intp]:
    """Indices (m,) in the map of the landmarks expected to be whole in a given view."""
    index = np.flatnonzero(observable(axis_position(prior.pose, mount), landmark_map, config))
    inside = fully_in_view(
        landmark_map.corners[index], prior.pose, camera, mount, pan_rad, tilt_rad, config.border_px
    )
    return index[inside]


def axis_position(pose_map_base: FloatArray, mount: PanTiltMount) -> FloatArray:
    """Position (3,) of the pan axis in map."""
    x, y, _ = mount.axis_pose_map(pose_map_base)
    return np.array([x, y, mount.axis_xyz[2]])


def observable(
    viewer: FloatArray, landmark_map: LandmarkMap, config: TripletConfig
) -> npt.NDArray[np.bool_]:
    """Which landmarks (n,) look as learned from a viewer (3,)."""
    visibility = landmark_visibilities(viewer, landmark_map, config)
    return np.asarray(visibility == LandmarkVisibility.USABLE)


def landmark_visibilities(
    viewer: FloatArray, landmark_map: LandmarkMap, config: TripletConfig
) -> npt.NDArray[np.int8]:
    """
    `LandmarkVisibility` of the landmarks (n,) from a viewer (3,): observation area, range, walls.

    Landmarks without a size are points of other sensors: there is no image of them.
    """
    position = landmark_map.positions
    away = position[:, :2] - viewer[:2]
    distance = np.hypot(away[:, 0], away[:, 1])
    visibility = np.full(len(position), LandmarkVisibility.USABLE, dtype=np.int8)
    views = position, landmark_map.normals, landmark_map.viewpoints, viewer
    well = observed_well(*views, config.min_sampling, config.max_sampling)
    within = (distance >= config.min_range_m) & (distance <= config.max_range_m)
    sized = landmark_map.sizes_m.min(axis=1, initial=np.inf) > 0.0
    visibility[~well] = LandmarkVisibility.OUTSIDE_AREA
    visibility[~within] = LandmarkVisibility.OUT_OF_RANGE
    visibility[~sized] = LandmarkVisibility.NO_IMAGE
    left = np.flatnonzero(visibility == LandmarkVisibility.USABLE)
    room = landmark_map.room
    if room is not None and len(left):
        # A wall does not hide a landmark that was learned through it: there is a door, a window,
        # a mirror, or a gap between the facades found.
        opaque = ~landmark_map.seen_through[left]
        hidden = (room.hiding(viewer[:2], position[left, :2]) & opaque).any(axis=-1)
        visibility[left[hidden]] = LandmarkVisibility.HIDDEN
    return visibility


def fully_in_view(
    points_map: FloatArray,
    pose_map_base: FloatArray,
    camera: CameraModel,
    mount: PanTiltMount,
    pan_rad: FloatArray | float,
    tilt_rad: float,
    border_px: float,
) -> npt.NDArray[np.bool_]:
    """
    Whether views (m,) contain all of their points (m, k, 3).

    `pan_rad` is one pan for each view (m,), or one for all.
    """
    rotation, center = mount.camera_pose_map(pose_map_base, pan_rad, tilt_rad)
    points = (points_map - center[..., None, :]) @ rotation
    inside = camera.contains(camera.project(points), border_px)
    return np.asarray(inside.all(axis=-1))
