"""
Triplet selection: the three landmarks that promise the least uncertain pose in one view.

Madsen and Andersen, Optimal landmark selection for triangulation of robot position, Robotics and
Autonomous Systems 23(4), 1998: propagate the measurement noise through the triangulation for every
triplet that fits one view. Here the map's errors count too, those that landmarks share as such.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.triangulation_model import (
    axis_from_base,
    base_from_axis,
    bearing_gradients,
    map_share,
)
from landmark_nav.localization.triplet_geometry import (
    position_variance,
    sightings,
    triplets_in_one_view,
    ViewTriplets,
)
from landmark_nav.localization.triplet_visibility import (
    axis_position,
    observable,
    patch_corners,
    TripletConfig,
    visible_landmarks,
    whole_in_view,
)
from landmark_nav.types import FloatArray, LandmarkMap, PoseEstimate, Refusal, Triplet

__all__ = ['TripletConfig', 'select_triplet', 'visible_landmarks']

IndexArray = npt.NDArray[np.intp]

# How many of the best triplets are looked at more closely at a time.
_SHORTLIST = 64
# Greatest share of half the view that a wide prior may claim as margin.
_MAX_MARGIN = 0.25


def select_triplet(
    prior: PoseEstimate,
    landmark_map: LandmarkMap,
    camera: CameraModel,
    mount: PanTiltMount,
    config: TripletConfig,
    joint_limits: tuple[float, float] | None = None,
    pan_rad: float | None = None,
    tilt_rad: float = 0.0,
    previous: Triplet | None = None,
    found_rate: npt.ArrayLike | None = None,
) -> Triplet | Refusal:
    """
    Choose three landmarks and the pan that sees them.

    Parameters
    ----------
    prior : PoseEstimate
        Of the base in map; its spread widens the margins and averages the promise.
    landmark_map : LandmarkMap
        What was learned.
    camera, mount : CameraModel, PanTiltMount
        What looks.
    config : TripletConfig
        What counts as visible.
    joint_limits : tuple of float, optional
        Least and greatest pan, radians; a full turn by default.
    pan_rad : float, optional
        The camera can't be turned: only what is in that view.
    tilt_rad : float
        Tilt, positive upwards.
    previous : Triplet, optional
        What is being looked at; kept unless another is better by `config.hysteresis`.
    found_rate : array_like, shape (n,), optional
        How often each landmark was found when looked for, (0, 1].

    Returns
    -------
    Triplet or Refusal
        `sigma_rad` is the spread of the expected bearings by prior and map; `covariance` is that
        of the base's pose.

    """
    axis = axis_from_base(prior, mount)
    index = _alone_in_view(prior, landmark_map, camera, mount, tilt_rad, config)
    if len(index) < 3:
        return Refusal('fewer than three landmarks are visible', f'{len(index)} of the map')
    bearing, sigma = _expected_bearings(axis, landmark_map, index)
    corners = patch_corners(landmark_map)[index]
    half_fov = _half_fov(camera)
    # However wide the prior, some of the picture stays to be used.
    margin = np.minimum(config.margin_sigmas * sigma, _MAX_MARGIN * half_fov)
    reach = half_fov - margin - _half_width(axis.pose, corners)
    yaw = mount.axis_rpy[2]
    limits = (pan_rad, pan_rad) if pan_rad is not None else joint_limits or (-np.pi, np.pi)
    views = triplets_in_one_view(bearing - yaw, reach, limits)
    if not len(views.triplets):
        return Refusal('fewer than three landmarks fit one view', f'{len(index)} are visible')

    score = position_variance(
        sightings(axis.pose[:2], landmark_map, index, config.bearing_sigma_rad), views.triplets
    )
    chance = np.ones(len(index)) if found_rate is None else np.asarray(found_rate)[index]
    weight = 1.0 / np.prod(chance[views.triplets], axis=-1)
    kept = _position_of(previous, landmark_map.ids[index], views.triplets)
    for place in _by_promise(score * weight, kept):
        averaged = weight[place] * _averaged(
            axis, landmark_map, index, views.triplets[place], config
        )
        if kept is not None:
            averaged[place == kept] /= 1.0 + config.hysteresis
        place = place[np.argsort(averaged, kind='stable')]
        whole = whole_in_view(
            corners[views.triplets[place]].reshape(len(place), -1, 3),
            prior.pose,
            camera,
            mount,
            views.pan_rad[place],
            tilt_rad,
            config.border_px,
        )
        if np.any(whole):
            return _triplet(
                axis, landmark_map, index, views, int(place[np.argmax(whole)]), mount, config
            )
    return Refusal('fewer than three landmarks fit one view', 'patches are cut by its border')


def _alone_in_view(
    prior: PoseEstimate,
    landmark_map: LandmarkMap,
    camera: CameraModel,
    mount: PanTiltMount,
    tilt_rad: float,
    config: TripletConfig,
) -> IndexArray:
    """Return the observable landmarks that a camera turned right to them sees whole."""
    viewer = axis_position(prior.pose, mount)
    index = np.flatnonzero(observable(viewer, landmark_map, config))
    delta = landmark_map.positions[index, :2] - viewer[:2]
    pan = np.arctan2(delta[:, 1], delta[:, 0]) - prior.pose[2] - mount.axis_rpy[2]
    corners = patch_corners(landmark_map)[index]
    return index[
        whole_in_view(corners, prior.pose, camera, mount, pan, tilt_rad, config.border_px)
    ]


def _expected_bearings(
    axis: PoseEstimate, landmark_map: LandmarkMap, index: IndexArray
) -> tuple[FloatArray, FloatArray]:
    """Bearings (n,) at the pan axis and their sigmas (n,) by prior and map."""
    position = landmark_map.positions[index, :2]
    delta = position - axis.pose[:2]
    bearing = wrap_rad(np.arctan2(delta[:, 1], delta[:, 0]) - axis.pose[2])
    gradient = bearing_gradients(axis.pose, position)
    jacobian = np.column_stack([gradient, np.full(len(index), -1.0)])
    variance = np.einsum('ni,ij,nj->n', jacobian, axis.covariance, jacobian)
    variance += np.einsum(
        'ni,nij,nj->n', gradient, landmark_map.covariances[index, :2, :2], gradient
    )
    return bearing, np.sqrt(variance)


def _half_width(axis_pose: FloatArray, corners: FloatArray) -> FloatArray:
    """Greatest angle (n,) between the centre of a patch and its corners (n, 4, 3), in plan."""
    delta = corners[..., :2] - axis_pose[:2]
    azimuth = np.arctan2(delta[..., 1], delta[..., 0])
    center = delta.mean(axis=1)
    middle = np.arctan2(center[:, 1], center[:, 0])
    return np.asarray(np.abs(wrap_rad(azimuth - middle[:, None])).max(axis=1))


def _position_of(
    previous: Triplet | None, ids: npt.NDArray[np.int64], triplets: IndexArray
) -> int | None:
    """Place of the previous triplet among the feasible ones; None if it is not."""
    if previous is None:
        return None
    same = np.flatnonzero((np.sort(ids[triplets], -1) == np.sort(previous.ids)).all(axis=-1))
    return int(same[0]) if len(same) else None


def _by_promise(score: FloatArray, kept: int | None) -> list[IndexArray]:
    """Places of the finite scores in batches, best first; the kept one in the first batch."""
    order = np.argsort(score, kind='stable')
    order = order[np.isfinite(score[order])]
    if kept is not None and np.isfinite(score[kept]):
        order = np.concatenate([[kept], order[order != kept]])
    return [order[k : k + _SHORTLIST] for k in range(0, len(order), _SHORTLIST)]


def _averaged(
    axis: PoseEstimate,
    landmark_map: LandmarkMap,
    index: IndexArray,
    triplets: IndexArray,
    config: TripletConfig,
) -> FloatArray:
    """Mean predicted variance (t,) over the four sigma points of the prior's position."""
    value, vector = np.linalg.eigh(axis.covariance[:2, :2])
    steps = (vector * np.sqrt(2.0 * np.maximum(value, 0.0))).T
    points = axis.pose[:2] + np.concatenate([steps, -steps])
    seen = sightings(points, landmark_map, index, config.bearing_sigma_rad)
    return np.asarray(position_variance(seen, triplets).mean(axis=0))


def _triplet(
    axis: PoseEstimate,
    landmark_map: LandmarkMap,
    index: IndexArray,
    views: ViewTriplets,
    place: int,
    mount: PanTiltMount,
    config: TripletConfig,
) -> Triplet | Refusal:
    """Return the chosen triplet with the full covariance of its fix."""
    chosen = index[views.triplets[place]]
    gradient = bearing_gradients(axis.pose, landmark_map.positions[chosen, :2])
    rows = np.stack([2 * chosen, 2 * chosen + 1], -1).reshape(-1)
    noise = map_share(gradient, landmark_map.joint_covariance_xy[np.ix_(rows, rows)])
    noise += config.bearing_sigma_rad**2 * np.eye(3)
    inverse = np.linalg.inv(np.column_stack([gradient, np.full(3, -1.0)]))
    fix = PoseEstimate(axis.stamp_ns, axis.pose, inverse @ noise @ inverse.T)
    sigma_m = float(np.sqrt(np.trace(fix.covariance[:2, :2])))
    if sigma_m > config.max_sigma_m:
        return Refusal('no triplet is accurate enough', f'the best promises {sigma_m:.2f} m')
    bearing, sigma = _expected_bearings(axis, landmark_map, chosen)
    return Triplet(
        axis.stamp_ns,
        landmark_map.ids[chosen],
        bearing,
        sigma,
        base_from_axis(fix, mount).covariance,
        float(views.pan_rad[place]),
    )


@lru_cache(maxsize=8)
def _half_fov(camera: CameraModel) -> float:
    return camera.half_fov_rad
