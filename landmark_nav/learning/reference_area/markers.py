"""
Pose of a sweep from ArUco and AprilTag markers at known places.

Their corners in the panorama are fitted at once: numbers tell the markers apart, so that there is
no search (resection; the start is the rigid alignment of Kabsch, 1976, of the centres by PnP).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.least_squares import covariance_of
from landmark_nav.learning.panorama.synthesis import CylinderImage
from landmark_nav.learning.reference_area.fit import PaperFit
from landmark_nav.learning.reference_area.model import in_base, PaperPlaces, ReferenceAreaConfig
from landmark_nav.learning.sheets import (
    CORNER_SIGMA_PX,
    CORNERS,
    locate_square,
    marker_corners,
    RESPONSE_SIGMA_PX,
)
from landmark_nav.types import FloatArray

# Fewest markers in view.
LEAST_MARKERS = 2
# x, y, heading of the base; height and two tilts of the pan axis; shift of all edges outwards;
# shifts of each marker to the left and up.
_POSE, _MOUNT, _RESPONSE, _HANG = slice(0, 3), slice(3, 6), 6, slice(7, None)


def fit_markers(
    view: CylinderImage,
    height_m: float,
    room: Room,
    mount: PanTiltMount,
    config: ReferenceAreaConfig,
) -> tuple[PaperFit, list[str]]:
    """
    Fit the pose of the base to the markers of a room in a panorama, and name those that it shows.

    `height_m` is the given height of the viewpoint.

    Raises `LandmarkNavError`: fewer than two of them are in view, or some hang turned.
    """
    found = marker_corners(view.image, view.cylinder, room.marker_dictionary)
    numbers = [number for number, _ in found]
    # A number that is there twice does not tell which of them is the one of the room file.
    single = {number: rays for number, rays in found if numbers.count(number) == 1}
    corner_rad = float(np.hypot(CORNER_SIGMA_PX / view.cylinder.fx, mount.pan_sigma_rad))
    seen, rays, centers = [], [], []
    for marker in room.markers:
        if marker.number in single:
            located = locate_square(single[marker.number], marker.size, corner_rad)
            if located is not None:
                seen.append(marker)
                rays.append(single[marker.number])
                centers.append(located[0])
    if len(seen) < LEAST_MARKERS:
        raise LandmarkNavError(
            f'{len(seen)} of the {len(room.markers)} markers of the room file are in view, of '
            f'{room.marker_dictionary}: {LEAST_MARKERS} are needed; see that they hang in view'
        )
    _check_upright([marker.name for marker in seen], np.array(rays))
    places = PaperPlaces.hung(
        room, [marker.center for marker in seen], [[marker.size] * 2 for marker in seen]
    )
    measured = _angles(np.array(rays))
    reach = np.linalg.norm(centers, axis=1)
    sigma = np.hypot(corner_rad, config.center_sigma_m / reach)[:, None, None]
    prior = np.array(
        [
            *[max(config.height_sigma_m, 1e-6), *[config.horizon_sigma_rad] * 2],
            RESPONSE_SIGMA_PX / view.cylinder.fx,
            *[max(config.paper_sigma_m, 1e-6)] * (2 * len(seen)),
        ]
    )

    def residuals(state: FloatArray) -> FloatArray:
        axis, errors = mount.axis_pose_map(state[_POSE]), state[_MOUNT].copy()
        errors[0] += height_m
        hang = state[_HANG].reshape(-1, 2)
        corners = places.center[:, None] + np.einsum(
            'kci,kij->kcj',
            hang[:, None] + 0.5 * places.size[:, None] * CORNERS,
            np.stack([places.along, np.tile([0.0, 0.0, 1.0], (len(seen), 1))], 1),
        )
        off = _angles(in_base(corners, axis, errors)) + state[_RESPONSE] * CORNERS - measured
        off[..., 0] = wrap_rad(off[..., 0])
        return np.append((off / sigma).ravel(), state[3:] / prior)

    start = np.zeros(3 + len(prior))
    start[_POSE] = _aligned(np.array(centers)[:, :2], places.center[:, :2], mount)
    best = least_squares(residuals, start, x_scale='jac')
    freedom = measured.size - 3
    misfit = float(2.0 * best.cost / freedom)
    covariance = covariance_of(best.jac.T @ best.jac) * max(1.0, misfit)
    order, all_seen = [0, 1, 3, 2], np.ones(len(seen))
    fit = PaperFit(
        best.x[_POSE],
        covariance[np.ix_(order, order)],
        all_seen,
        all_seen,
        best.x[_HANG].reshape(-1, 2),
        best.x[_MOUNT],
        covariance[_MOUNT, _MOUNT],
        0.0,
        0.0,
        np.zeros(2),
        misfit,
    )
    return fit, [f'marker {marker.number}' for marker in seen]


def _check_upright(names: list[str], rays: FloatArray) -> None:
    """Raise `LandmarkNavError` if corners (k, 4, 3) are nearer to those of turned markers."""
    corners = _angles(rays)
    off = corners - corners[:, :1]
    off[..., 0] = wrap_rad(off[..., 0])
    off -= off.mean(axis=1, keepdims=True)
    by_turn = [np.sum(off * np.roll(CORNERS, turn, axis=0), axis=(1, 2)) for turn in range(4)]
    turns = np.argmax(by_turn, axis=0)
    if turns.any():
        words = ['', '90 deg to the left', '180 deg', '90 deg to the right']
        turned = [
            f'{name} by {words[turn]}' for name, turn in zip(names, turns, strict=True) if turn
        ]
        raise LandmarkNavError(
            f'turned in their plane: {", ".join(turned[:4])}: hang them upright, or set '
            'camera_roll in robot.yaml if the camera is'
        )


def _angles(rays: FloatArray) -> FloatArray:
    """Azimuths and tangents of elevation (..., 2) of rays (..., 3)."""
    x, y, z = np.moveaxis(rays, -1, 0)
    return np.stack([np.arctan2(y, x), z / np.hypot(x, y)], -1)


def _aligned(seen: FloatArray, hung: FloatArray, mount: PanTiltMount) -> FloatArray:
    """Pose (3,) of the base at which points (k, 2) about its pan axis are at places (k, 2)."""
    off, there = seen - seen.mean(axis=0), hung - hung.mean(axis=0)
    heading = np.arctan2(
        np.sum(off[:, 0] * there[:, 1] - off[:, 1] * there[:, 0]), np.sum(off * there)
    )
    cos, sin = np.cos(heading), np.sin(heading)
    turn = np.array([[cos, -sin], [sin, cos]])
    axis = hung.mean(axis=0) - turn @ (seen.mean(axis=0) + mount.axis_xyz[:2])
    return np.append(axis, heading)
