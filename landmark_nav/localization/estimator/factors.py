"""
Models of images and wheels as functions of the state, with analytic derivatives.

A detection is a point of the normalised image plane (x/z to the right, y/z down), undistorted by
the calibrated lens. It depends on pose and tilt of the base, mount, pan, focal length, principal
point, joint delay and rolling shutter. A measured bearing is the same with a camera that looks
along it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IndexArray
from landmark_nav.calibration import NAMES
from landmark_nav.geometry.angles import PanTrack, wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.odometry.noise import Motion
from landmark_nav.types import FloatArray

# First index of each block of the state: pose of the base; pitch and roll of the base by an uneven
# floor; scale, drift and turn scale of the odometry, its side slip and the way lost in turns;
# calibration; then the shared map factors.
POSE, FLOOR_TILT, SCALE, DRIFT, TURN_SCALE, SLIP, TURN_LOSS, CALIBRATION = 0, 3, 5, 6, 7, 8, 9, 10
STATES = CALIBRATION + len(NAMES)
_AXIS, _RPY, CENTER = CALIBRATION, CALIBRATION + 3, CALIBRATION + 6
ROLL, TILT, PAN_SCALE, FOCAL, PRINCIPAL, _, DELAY, ROW_DELAY = range(CALIBRATION + 9, STATES)
YAW = _RPY + 2
# Least depth of a visible point, m.
_LEAST_DEPTH_M = 0.05
# Greatest angle between a bearing and the optical axis.
_WIDEST_RAD = 1.0
# Least step of the derivative of the pan by time, s: over a shorter one noise dominates.
LEAST_STEP_S = 0.02


def image_points(
    uv_px: FloatArray,
    covariance_px2: FloatArray,
    camera: CameraModel,
    known: CameraModel,
    rays: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Normalised image coordinates (m, 2) of pixels, their covariances, and `ImagePoints.by_lens`.

    The lens bends rays by how far they are off the axis. That is removed with the lens that is
    `known` by now, and a linear model of others, so that points do not depend on what is known.
    `rays` (m, 3, 3) are its rays at the pixels with `HALF_PIXEL` added.
    """
    rays = rays[..., :2]
    scale, shift = known.fx / camera.fx - 1.0, (known.cx - camera.cx) / camera.fx
    k1 = known.coefficients[0] - camera.coefficients[0]
    bent = 2.0 * (rays[:, 1:] - rays[:, :1]).swapaxes(1, 2) * [known.fx, known.fy]
    seen = (uv_px - [known.cx, known.cy]) / [known.fx, known.fy]
    by_focal = rays[:, 0] - (bent @ seen[..., None])[..., 0]
    by_k1 = -(bent @ known.by_distortion(rays[:, 0])[..., None])[..., 0]
    by_lens = np.stack([by_focal, [1.0, 0.0] - bent[..., 0], by_k1], -1)
    points = (1.0 + scale) * rays[:, 0] + [shift, 0.0] - by_lens @ [scale, shift, k1]
    by_uv = bent / [camera.fx, camera.fy]
    return points, by_uv @ covariance_px2 @ by_uv.swapaxes(1, 2), by_lens


@dataclass(frozen=True, eq=False)
class ImagePoints:
    """
    Landmarks found in one image.

    Parameters
    ----------
    stamp_ns : int
        Time of the image.
    columns : ndarray of int, shape (m,)
        Their indices in the map.
    points : ndarray, shape (m, 2)
        Normalised image coordinates.
    covariance : ndarray, shape (m, 2, 2)
        Covariance of each point.
    pan_rad : ndarray, shape (m,)
        Measured pan.
    tilt_rad : float
        Measured tilt.
    pan_rate_rad_s, pan_sigma_rad : float
        Rate of the pan, and the sigma of the measured pan, an error that all points share.
    pan_track : PanTrack, optional
        Pan around the stamp; without it the rate is used.
    rows : bool
        Whether y/z is measured; not for bearings.
    missed : ndarray of int, shape (k,)
        Landmarks that should be in view and were not found.
    delay_step_s : float
        Step of the derivative by the delay, during which the pan may begin to turn.
    near : ndarray, shape (3,), optional
        Pose of the base by the image itself, if the prior was uncertain: the first linearization
        point, not a measurement.
    sizes : ndarray, shape (m, 2), optional
        Width and height of the templates: one of a wrong scale fits at any of its points.
    by_lens : ndarray, shape (m, 2, 3), optional
        Derivatives of the undistorted points of given pixels by focal scale, principal point and
        distortion; `points` are linearly extrapolated to the lens of camera_info.
    below : ndarray, shape (m,), optional
        Rows of given pixels below the principal point, in focal lengths; without them, a rolling
        shutter has no effect.
    moved_back : ndarray, shape (3,)
        Pose of the base when the image was taken, in the base at the stamp.
    speeds : ndarray, shape (3,)
        Speeds of the base ahead and to the left, m/s, and its turning rate, rad/s.
    lost : bool
        Whether the pose was lost before: then no step is assumed, as another place is likelier.
    """

    stamp_ns: int
    columns: IndexArray
    points: FloatArray
    covariance: FloatArray
    pan_rad: FloatArray
    tilt_rad: float = 0.0
    pan_rate_rad_s: float = 0.0
    pan_sigma_rad: float = 0.0
    pan_track: PanTrack | None = None
    rows: bool = True
    missed: IndexArray = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    delay_step_s: float = LEAST_STEP_S
    near: FloatArray | None = None
    sizes: FloatArray | None = None
    by_lens: FloatArray | None = None
    below: FloatArray | None = None
    moved_back: FloatArray = field(default_factory=lambda: np.zeros(3))
    speeds: FloatArray = field(default_factory=lambda: np.zeros(3))
    lost: bool = False

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.columns)

    @classmethod
    def of_bearings(
        cls,
        stamp_ns: int,
        columns: IndexArray,
        bearing_base_rad: FloatArray,
        variance_rad2: FloatArray,
        mount: PanTiltMount,
        looked_base_rad: float | None = None,
        pan_sigma_rad: float = 0.0,
    ) -> ImagePoints:
        """
        Return the points of bearings (m,) at the pan axis, which were measured with this mount.

        `looked_base_rad` is the azimuth of the camera that saw them, where an error of its
        principal point changes them; without it, the camera looked at each.
        """
        bearing = np.asarray(bearing_base_rad, dtype=np.float64)
        off = np.zeros(len(columns))
        if looked_base_rad is not None and mount.pan_sense > 0.0:
            off = np.asarray(wrap_rad(bearing - looked_base_rad))
            off[np.abs(off) > _WIDEST_RAD] = 0.0
        right = -np.tan(off)
        covariance = np.zeros((len(columns), 2, 2))
        covariance[:, 0, 0] = variance_rad2 * (1.0 + right**2) ** 2
        covariance[:, 1, 1] = 1.0
        return cls(
            stamp_ns,
            columns,
            np.column_stack([right, np.zeros(len(columns))]),
            covariance,
            mount.pan_toward_rad(bearing - off),
            pan_sigma_rad=pan_sigma_rad,
            rows=False,
        )

    @classmethod
    def nothing(cls, stamp_ns: int) -> ImagePoints:
        """Return the points of an image without landmarks."""
        none = np.empty(0)
        return cls(stamp_ns, none.astype(np.intp), none.reshape(0, 2), none.reshape(0, 2, 2), none)

    def chosen(self, which: npt.NDArray[np.bool_]) -> ImagePoints:
        """Return the points selected by `which` (m,)."""
        return replace(
            self,
            columns=self.columns[which],
            points=self.points[which],
            covariance=self.covariance[which],
            pan_rad=self.pan_rad[which],
            sizes=None if self.sizes is None else self.sizes[which],
            by_lens=None if self.by_lens is None else self.by_lens[which],
            below=None if self.below is None else self.below[which],
        )

    def pans(self, delay_s: float, later_s: FloatArray) -> tuple[FloatArray, float]:
        """
        Pans (m,) for a delay of the joint states, and their derivative by the delay.

        Points are exposed later than the image by `later_s` (m,).
        """
        track = self.pan_track
        if track is None:
            return self.pan_rad + self.pan_rate_rad_s * (delay_s + later_s), self.pan_rate_rad_s
        step = self.delay_step_s
        given, before, after = track.at([0.0, delay_s - step, delay_s + step])
        return (
            self.pan_rad + (track.at(delay_s + later_s) - given),
            float((after - before) / (2.0 * step)),
        )

    def bend_rad(self, delay_s: float) -> float:
        """Deviation of the pan from that derivative, one step away."""
        if self.pan_track is None:
            return 0.0
        step = self.delay_step_s
        before, at, after = self.pan_track.at([delay_s - step, delay_s, delay_s + step])
        return float(0.5 * (after + before) - at)


class Projection(NamedTuple):
    """
    Predicted image points of landmarks.

    `points` (m, 2) with the derivatives `by_state` (m, 2, STATES) by the state, `by_point`
    (m, 2, 3) by the position of the landmark, `by_pan` (m, 2) by the measured pan; `ahead` (m,)
    marks those in front of the camera.
    """

    points: FloatArray
    by_state: FloatArray
    by_point: FloatArray
    by_pan: FloatArray
    ahead: npt.NDArray[np.bool_]


def project(state: FloatArray, points_map: FloatArray, seen: ImagePoints) -> Projection:
    """
    Project points (m, 3) in map, for the first STATES of a state.

    Points behind the camera are marked in `ahead`; their values are finite.
    """
    count = len(points_map)
    below = np.zeros(count) if seen.below is None else seen.below
    later_s = float(state[ROW_DELAY]) * below
    # Motion of the base, in map, from the stamp until each point was exposed.
    c, s = math.cos(state[2]), math.sin(state[2])
    to_map = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    speeds = to_map @ seen.speeds
    motion = to_map @ seen.moved_back + later_s[:, None] * speeds
    x, y, heading = (state[:3] + motion).T
    pitch, floor_roll = state[FLOOR_TILT:SCALE].tolist()
    pans, by_delay = seen.pans(float(state[DELAY]), later_s)
    scale = 1.0 + float(state[PAN_SCALE])
    tilt = seen.tilt_rad + float(state[TILT])
    axes, axis_from_base = _axis_frame(*state[_RPY : _RPY + 3].tolist())
    # A small pitch and roll of the base on an uneven floor, about its origin.
    tilting = np.array([[1.0, 0.0, -pitch], [0.0, 1.0, floor_roll], [pitch, -floor_roll, 1.0]])
    from_map = _turning(heading, 0.0)
    from_base = points_map - np.stack([x, y, np.zeros(count)], -1)
    upright = (from_map @ from_base[:, :, None])[:, :, 0]
    # From the base to the frame of the camera, (m, 3, 3).
    turn = _turning(scale * pans, tilt) @ axis_from_base
    away = upright @ tilting.T - state[_AXIS:_RPY]
    inner = (turn @ away[:, :, None])[:, :, 0]
    outer = inner - state[CENTER:ROLL]

    # Derivatives of `outer`: by x, y, heading, pitch and roll of the base, by the axis and its
    # angles, by the optical centre, by pan and tilt, by the point.
    by = np.zeros((count, 3, 19))
    by_point = turn @ tilting @ from_map
    by[:, :, :2] = -by_point[:, :, :2]
    moves = np.zeros((count, 3, 3))
    moves[:, 0, 0], moves[:, 1, 0] = upright[:, 1], -upright[:, 0]
    moves[:, :, 0] = moves[:, :, 0] @ tilting.T
    moves[:, 0, 1], moves[:, 2, 1] = -upright[:, 2], upright[:, 0]
    moves[:, 1, 2], moves[:, 2, 2] = upright[:, 2], -upright[:, 1]
    by[:, :, 2:5] = turn @ moves
    by[:, :, 5:8] = -turn
    # A rotation of the frame about an axis moves a point by minus their cross product.
    by[:, :, [8, 9, 10, 14]] = _cross(inner[:, :, None], turn @ axes)
    by[:, 0, 11] = by[:, 1, 12] = by[:, 2, 13] = -1.0
    by[:, 0, 15], by[:, 2, 15] = inner[:, 2], -inner[:, 0]
    by[:, :, 16:19] = by_point

    ahead = outer[:, 0] > _LEAST_DEPTH_M
    depth = np.where(ahead, outer[:, 0], 1.0)
    flat = -outer[:, 1:] / depth[:, None]
    roll, focal = float(state[ROLL]), 1.0 + float(state[FOCAL])
    rolled = np.array([[math.cos(roll), math.sin(roll)], [-math.sin(roll), math.cos(roll)]])
    flat_by = (focal * rolled) @ (
        (by[:, 1:] + flat[:, :, None] * by[:, :1]) / -depth[:, None, None]
    )
    turned = flat @ rolled.T
    points = focal * turned
    points[:, 0] += state[PRINCIPAL]
    by_pan = scale * flat_by[:, :, 14]
    by_state = np.zeros((count, 2, STATES))
    by_state[:, :, :FLOOR_TILT] = flat_by[:, :, :3]
    by_state[:, :, 2] += flat_by[:, :, 1] * motion[:, :1] - flat_by[:, :, 0] * motion[:, 1:2]
    by_state[:, :, FLOOR_TILT:SCALE] = flat_by[:, :, 3:5]
    by_state[:, :, _AXIS:ROLL] = flat_by[:, :, 5:14]
    by_state[:, 0, ROLL], by_state[:, 1, ROLL] = points[:, 1], -focal * turned[:, 0]
    by_state[:, :, TILT] = flat_by[:, :, 15]
    by_state[:, :, PAN_SCALE] = flat_by[:, :, 14] * pans[:, None]
    by_state[:, :, FOCAL] = turned
    by_state[:, 0, PRINCIPAL] = 1.0
    by_state[:, :, DELAY] = by_pan * by_delay
    later = by_state[:, :, DELAY] + flat_by[:, :, :3] @ speeds
    by_state[:, :, ROW_DELAY] = later * below[:, None]
    if seen.by_lens is not None:
        lens = slice(FOCAL, DELAY)
        points -= seen.by_lens @ state[lens]
        by_state[:, :, lens] -= seen.by_lens
    return Projection(points, by_state, flat_by[:, :, 16:19], by_pan, ahead)


def _cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """Cross products (m, 3, k) of vectors (m, 3, 1) and (m, 3, k); `np.cross` is much slower."""
    product = np.empty_like(second)
    for k, i, j in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        product[:, k] = first[:, i] * second[:, j] - first[:, j] * second[:, i]
    return product


def _axis_frame(roll: float, pitch: float, yaw: float) -> tuple[FloatArray, FloatArray]:
    """Axes (3, 4) in the base of roll, pitch, yaw and pan; rotation (3, 3) base to axis frame."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    axis_from_base = np.array(
        [
            [cy * cp, sy * cp, -sp],
            [cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr],
            [cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr],
        ]
    )
    axes = np.array([[cy * cp, -sy, 0.0], [sy * cp, cy, 0.0], [-sp, 0.0, 1.0]])
    return np.column_stack([axes, axis_from_base[2]]), axis_from_base


def _turning(pans: FloatArray, tilt: float) -> FloatArray:
    """Rotations (m, 3, 3) from the axis frame to the frame after pan and tilt."""
    c, s, ct, st = np.cos(pans), np.sin(pans), math.cos(tilt), math.sin(tilt)
    turning = np.zeros((len(pans), 3, 3))
    turning[:, 0, 0], turning[:, 0, 1], turning[:, 0, 2] = ct * c, ct * s, st
    turning[:, 1, 0], turning[:, 1, 1] = -s, c
    turning[:, 2, 0], turning[:, 2, 1], turning[:, 2, 2] = -st * c, -st * s, ct
    return turning


def moved(state: FloatArray, motion: Motion) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Return the state (CALIBRATION,) after a motion that the wheels measured, with its derivatives.

    Returns
    -------
    mean : ndarray, shape (CALIBRATION,)
        Predicted state, with the motion corrected by the errors of the odometry.
    by_state : ndarray, shape (CALIBRATION, CALIBRATION)
        Derivative by the state.
    by_motion : ndarray, shape (3, 3)
        Derivative of the pose by the motion.
    """
    forward, left, turn = motion.increment.tolist()
    x, y, heading = state[:3].tolist()
    scale, drift, turn_scale, slip, loss = state[SCALE:CALIBRATION].tolist()
    ahead = (1.0 + scale) * forward - loss * abs(turn)
    aside = (1.0 + scale) * left + slip * forward
    turned = (1.0 + turn_scale) * turn + drift * forward
    c, s = math.cos(heading), math.sin(heading)
    mean = state[:CALIBRATION].copy()
    mean[:3] = x + c * ahead - s * aside, y + s * ahead + c * aside, heading + turned
    by_state = np.eye(CALIBRATION)
    by_state[0, 2], by_state[1, 2] = -s * ahead - c * aside, c * ahead - s * aside
    by_state[0, SCALE], by_state[1, SCALE] = c * forward - s * left, s * forward + c * left
    by_state[0, SLIP], by_state[1, SLIP] = -s * forward, c * forward
    by_state[0, TURN_LOSS], by_state[1, TURN_LOSS] = -c * abs(turn), -s * abs(turn)
    by_state[2, DRIFT], by_state[2, TURN_SCALE] = forward, turn
    return mean, by_state, np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
