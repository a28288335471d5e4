"""
Which landmarks can be seen from the expected pose, at which pans, and how long the turn takes.

A landmark is whole in view while the pan is within its reach of the landmark's azimuth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IndexArray
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.se2 import bearings
from landmark_nav.localization.triangulation.model import axis_from_base, bearing_gradients
from landmark_nav.localization.triplet.ranking import LandmarkVisibility
from landmark_nav.localization.triplet.visibility import (
    axis_position,
    fully_in_view,
    landmark_visibilities,
    TripletConfig,
)
from landmark_nav.types import FloatArray, LandmarkMap, PoseEstimate

_TURN = 2.0 * np.pi


class Tours(NamedTuple):
    """
    Views of triplets (t,).

    At `pan_rad` (t,) all three are in view; `cost` (t,) is the time of a look and the turn to it,
    relative to that of a look: infinite where no view holds all three.
    """

    pan_rad: FloatArray
    cost: FloatArray


def travel_s(way_rad: npt.ArrayLike, rate_rad_s: float, acceleration_rad_s2: float) -> FloatArray:
    """Duration (...) of a turn with a trapezoidal profile of the rate."""
    way = np.maximum(np.asarray(way_rad, dtype=np.float64), 0.0)
    ramps = rate_rad_s**2 / acceleration_rad_s2
    short = 2.0 * np.sqrt(np.minimum(way, ramps) / acceleration_rad_s2)
    return np.asarray(short + np.maximum(way - ramps, 0.0) / rate_rad_s)


@dataclass(frozen=True, eq=False)
class PanWindows:
    """
    Intervals of pan (m,) in which a landmark is whole in view, one for each turn of the axis.

    Parameters
    ----------
    place : ndarray of int, shape (m,)
        Index of the landmark.
    lower, upper : ndarray, shape (m,)
        Least and greatest pan.
    pan_rad : float or None
        Pan now, if the time of turns counts.
    config : TripletConfig
        Speed of the pan unit.
    """

    place: IndexArray
    lower: FloatArray
    upper: FloatArray
    pan_rad: float | None
    config: TripletConfig

    @classmethod
    def around(
        cls,
        azimuth_rad: FloatArray,
        reach_rad: FloatArray,
        limits_rad: tuple[float, float],
        pan_rad: float | None,
        config: TripletConfig,
    ) -> PanWindows:
        """
        Windows of n landmarks, within the limits of the joint.

        Parameters
        ----------
        azimuth_rad : ndarray, shape (n,)
            Azimuth of the landmarks in the frame of the pan axis, within (-pi, pi].
        reach_rad : ndarray, shape (n,)
            Greatest difference of pan and azimuth at which the landmark is whole in view.
        limits_rad : tuple of float
            Least and greatest pan.
        pan_rad, config
            As above.
        """
        first, last = (round(limit / _TURN) for limit in limits_rad)
        turns = _TURN * np.arange(first - 1, last + 2)[:, None]
        lower = np.maximum(azimuth_rad + turns - reach_rad, limits_rad[0])
        upper = np.minimum(azimuth_rad + turns + reach_rad, limits_rad[1])
        turn, place = np.nonzero(lower <= upper)
        return cls(place, lower[turn, place], upper[turn, place], pan_rad, config)

    def costs(self) -> FloatArray:
        """
        Cost (m, m) of looking at two landmarks, relative to a look without a turn.

        The cost of a triplet is the largest of its pairs. It is infinite for two windows of one
        landmark, and where no view holds both.
        """
        near = np.minimum(self.upper[:, None], self.upper)
        far = np.maximum(self.lower[:, None], self.lower)
        return np.where(self.place[:, None] != self.place, self._cost(near, far), np.inf)

    def tours(self, triplets: IndexArray) -> Tours:
        """Return the view of each triplet (t, 3)."""
        near, far = self.upper[triplets].min(axis=-1), self.lower[triplets].max(axis=-1)
        return Tours(0.5 * (far + near), self._cost(near, far))

    def _cost(self, near: FloatArray, far: FloatArray) -> FloatArray:
        """Cost (...) of a turn to the overlap of windows, `far` to `near`; infinite if none."""
        way = np.zeros_like(near)
        if self.pan_rad is not None:
            way = np.maximum(far - self.pan_rad, self.pan_rad - near)
        seconds = travel_s(way, self.config.pan_rate_rad_s, self.config.pan_acceleration_rad_s2)
        return np.where(far <= near, 1.0 + seconds / self.config.dwell_time_s, np.inf)


# Greatest margin for an uncertain prior, relative to half the field of view.
_MAX_MARGIN = 0.25


@dataclass(frozen=True)
class CameraState:
    """
    Where the camera looks and how far it can turn.

    Parameters
    ----------
    pan_rad : float or None
        Pan now: turning away from it takes time. None if that does not count.
    tilt_rad : float
        Tilt, positive upwards.
    limits_rad : tuple of float
        Least and greatest pan; the same twice for a camera that does not turn.
    """

    pan_rad: float | None = None
    tilt_rad: float = 0.0
    limits_rad: tuple[float, float] = (-np.pi, np.pi)


@dataclass(frozen=True, eq=False)
class PlanningScene:
    """
    A map seen from a prior pose of the base.

    Parameters
    ----------
    prior : PoseEstimate
        Pose of the base in map; its covariance widens the margins.
    landmark_map : LandmarkMap
        n landmarks.
    camera, mount : CameraModel, PanTiltMount
        Intrinsics and extrinsics.
    config : TripletConfig
        What counts as visible.
    camera_state : CameraState
        Where the camera looks and how far it can turn.
    """

    prior: PoseEstimate
    landmark_map: LandmarkMap
    camera: CameraModel
    mount: PanTiltMount
    config: TripletConfig
    camera_state: CameraState

    @cached_property
    def axis(self) -> PoseEstimate:
        """Expected pose of the pan axis, with the orientation of the base."""
        return axis_from_base(self.prior, self.mount)

    def visibility(self) -> npt.NDArray[np.int8]:
        """`LandmarkVisibility` of each landmark (n,)."""
        viewer = axis_position(self.prior.pose, self.mount)
        visibility = landmark_visibilities(viewer, self.landmark_map, self.config)
        index = np.flatnonzero(visibility == LandmarkVisibility.USABLE)
        windows = self.windows(index)
        reachable = np.zeros(len(index), dtype=np.bool_)
        reachable[windows.place] = True
        # A landmark straight ahead of a pan must be whole there: neither too high nor too low.
        azimuth = self._azimuth_and_reach[0, index]
        straight = np.clip(azimuth, *self.camera_state.limits_rad)
        ahead = np.abs(straight - azimuth) < 1e-9
        whole = self.whole(self.landmark_map.corners[index], straight) | ~ahead
        visibility[index[~whole]] = LandmarkVisibility.CUT
        visibility[index[~reachable]] = LandmarkVisibility.BEYOND_LIMITS
        return visibility

    def windows(self, index: IndexArray) -> PanWindows:
        """Pans at which each of the landmarks `index` (m,) is probably whole in the image."""
        azimuth, reach = self._azimuth_and_reach[:, index]
        limits, pan = self.camera_state.limits_rad, self.camera_state.pan_rad
        return PanWindows.around(azimuth, reach, limits, pan, self.config)

    @cached_property
    def _azimuth_and_reach(self) -> FloatArray:
        """Pan toward each landmark, and greatest deviation from it, (2, n)."""
        bearing, sigma = self.expected_bearings(np.arange(len(self.landmark_map.corners)))
        half_fov = self.camera.half_fov_rad
        # With any prior, some of the image remains usable.
        margin = np.minimum(self.config.margin_sigmas * sigma, _MAX_MARGIN * half_fov)
        reach = half_fov - margin - _half_width(self.axis.pose, self.landmark_map.corners)
        return np.stack([self.mount.pan_toward_rad(bearing), reach])

    def whole(self, corners: FloatArray, pan_rad: FloatArray) -> npt.NDArray[np.bool_]:
        """Whether views (m,) contain the corners (m, 4, 3) of their patches."""
        tilt_rad, border_px = self.camera_state.tilt_rad, self.config.border_px
        return fully_in_view(
            corners, self.prior.pose, self.camera, self.mount, pan_rad, tilt_rad, border_px
        )

    def expected_bearings(self, index: IndexArray) -> tuple[FloatArray, FloatArray]:
        """Bearings (n,) at the pan axis and their sigmas (n,) by prior and map."""
        position = self.landmark_map.positions[index, :2]
        bearing = bearings(self.axis.pose, position)
        gradient = bearing_gradients(self.axis.pose, position)
        jacobian = np.column_stack([gradient, np.full(len(index), -1.0)])
        own = self.landmark_map.covariances[index, :2, :2]
        variance = (jacobian @ self.axis.covariance * jacobian).sum(axis=-1)
        variance += ((gradient[:, None] @ own)[:, 0] * gradient).sum(axis=-1)
        return bearing, np.sqrt(variance)


def _half_width(axis_pose: FloatArray, corners: FloatArray) -> FloatArray:
    """Greatest angle (n,) between the centre of a patch and its corners (n, 4, 3), in plan."""
    delta = corners[..., :2] - axis_pose[:2]
    azimuth = np.arctan2(delta[..., 1], delta[..., 0])
    center = delta.mean(axis=1)
    middle = np.arctan2(center[:, 1], center[:, 0])
    return np.asarray(np.abs(wrap_rad(azimuth - middle[:, None])).max(axis=1, initial=0.0))
