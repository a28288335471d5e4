"""
Fixes from detections of several images, taken while the robot moves and the camera turns.

Every bearing is carried to a common time by odometry. If the pan axis was displaced by ``v`` (in
the base frame of the common time) when landmark ``L`` was sighted, then the bearing, turned with
the robot, is that of a virtual landmark at ``L - R(heading) v``. Triangulation is repeated with
the heading that it gives. Errors of odometry count as errors of the virtual landmarks; those
sighted at the same time, or over the same way, share them.

Font-Llagunes and Batlle, Consistent triangulation for mobile robot localization using
discontinuous angular measurements, Robotics and Autonomous Systems 57(9), 2009, treat the same
question with a filter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import compose, compose_jacobians, inverse, rotation
from landmark_nav.localization.odometry.noise import (
    jitter_variances,
    motion_variances,
    OdometryNoiseConfig,
)
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.localization.triangulation.model import axis_from_base, base_from_axis
from landmark_nav.localization.triangulation.robust import Fix, triangulate, TriangulationConfig
from landmark_nav.types import (
    Detections,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
    Triplet,
)

__all__ = ['BearingBuffer']

# Virtual landmarks use the heading of the previous pass; each pass leaves a tenth of its error.
_PASSES = 10
_CLOSE_M = 1e-6
# Odometry is kept so much longer than needed.
_SPARE_NS = 1_000_000_000


class _Bearing(NamedTuple):
    stamp_ns: int
    bearing_rad: float
    variance_rad2: float
    pan_variance_rad2: float


class BearingBuffer:
    """
    The last detection of each landmark, until a fix has used it.

    Parameters
    ----------
    mount : PanTiltMount
        Where the pan axis, the apex of all bearings, sits on the base.
    window_s : float
        For how long a detection counts; 0 leaves those of the last image.

    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        mount: PanTiltMount,
        window_s: float,
        odometry: OdometryNoiseConfig,
        triangulation: TriangulationConfig,
    ) -> None:
        self._map, self._mount = landmark_map, mount
        self._lever = np.asarray(mount.axis_xyz[:2], dtype=np.float64)
        self._window_ns = int(1e9 * window_s)
        self._odometry, self._triangulation = odometry, triangulation
        self._pan_variance = mount.pan_sigma_rad**2
        self._track = OdometryTrack(odometry)
        self._bearings: dict[int, _Bearing] = {}

    def add_odometry(self, sample: OdometrySample) -> None:
        """Take odometry; with a window of one image none is needed."""
        if not self._window_ns:
            return
        # The filter reports what is wrong with it.
        self._track.add(sample)
        self._track.trim(sample.stamp_ns - 2 * self._window_ns - _SPARE_NS)

    def add(self, found: Detections) -> None:
        """Take the landmarks of an image, and forget what is older than the window."""
        oldest = found.stamp_ns - self._window_ns
        pan_variance = self._pan_variance + found.pan_sigma_rad**2
        self._bearings = {
            k: entry
            for k, entry in self._bearings.items()
            if oldest <= entry.stamp_ns <= found.stamp_ns
        }
        for k, bearing, variance in zip(
            found.ids.tolist(), found.bearing_rad, found.variance_rad2, strict=True
        ):
            self._bearings[k] = _Bearing(
                found.stamp_ns, float(bearing), float(variance), pan_variance
            )

    def missing(self, triplet: Triplet) -> list[int]:
        """Landmarks of a triplet that are still to be sighted."""
        return [k for k in triplet.ids.tolist() if k not in self._bearings]

    def fix(self, prior: PoseEstimate) -> PoseEstimate | Refusal:
        """
        Triangulate the base at the time of the prior from all gathered detections.

        They are dropped after a fix, so that fixes are independent of each other.
        """
        ids = np.array(sorted(self._bearings), dtype=np.int64)
        if len(ids) < 3:
            return Refusal('fewer than three bearings', f'{len(ids)} given')
        bearings = [self._bearings[k] for k in ids.tolist()]
        stamps = np.array([entry.stamp_ns for entry in bearings])
        motions, errors = self._motions(prior.stamp_ns, stamps)
        outcome = self._solved(
            self._map.indices(ids),
            np.array([entry.bearing_rad for entry in bearings]) + motions[:, 2],
            np.array([entry.variance_rad2 for entry in bearings]),
            motions,
            errors,
            np.array([entry.pan_variance_rad2 for entry in bearings])
            * (stamps[:, None] == stamps),
            axis_from_base(prior, self._mount),
        )
        if isinstance(outcome, Refusal):
            return outcome
        self._bearings.clear()
        return base_from_axis(outcome.at(prior.stamp_ns), self._mount)

    def _solved(
        self,
        index: np.ndarray[tuple[int], np.dtype[np.intp]],
        bearing: FloatArray,
        variance: FloatArray,
        motions: FloatArray,
        errors: FloatArray | None,
        pan_covariance: FloatArray,
        start: PoseEstimate,
    ) -> Fix | Refusal:
        """Triangulate the axis with virtual landmarks, iterating over the heading."""
        map_covariance = self._map.joint_covariance_of(index)
        position = self._map.positions[index, :2]
        turned = rotation(motions[:, 2])
        aside = motions[:, :2] + turned @ self._lever - self._lever
        # Derivative of `aside` by the motion's turn.
        arm = turned @ self._lever
        by_turn = np.array([-arm[:, 1], arm[:, 0]]).T
        pose = start.pose
        for _ in range(_PASSES):
            heading = rotation(pose[2])
            virtual = position - aside @ heading.T
            delta = virtual - pose[:2]
            # An error of the bearing counts as a shift of the landmark across the line of sight.
            across = np.array([-delta[:, 1], delta[:, 0]]).T
            carried = across[:, :, None, None] * pan_covariance[:, None, :, None] * across
            if errors is not None:
                by_motion = np.concatenate(
                    [
                        np.broadcast_to(-heading, (len(index), 2, 2)),
                        (-by_turn @ heading.T - across)[..., None],
                    ],
                    axis=-1,
                )
                carried += np.einsum('iab,ibjc,jdc->iajd', by_motion, errors, by_motion)
            outcome = triangulate(
                virtual,
                bearing,
                variance,
                map_covariance + carried.reshape(map_covariance.shape),
                start,
                self._triangulation,
            )
            if isinstance(outcome, Refusal):
                break
            moved = aside @ (rotation(outcome.pose[2]) - heading).T
            if np.abs(moved).max() < _CLOSE_M:
                break
            pose = outcome.pose
        return outcome

    def _motions(
        self, stamp_ns: int, stamps_ns: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        """
        Poses (n, 3) of the base at the detections, seen from that at `stamp_ns`, and their errors.

        The errors are a joint covariance (n, 3, n, 3); None where nothing moved meanwhile.
        """
        if (stamps_ns == stamp_ns).all():
            return np.zeros((len(stamps_ns), 3)), None
        times, place = np.unique(stamps_ns, return_inverse=True)
        poses = np.zeros((len(times), 3))
        # Each row of factors is what the errors of all ways between the times do to a pose.
        factors = np.zeros((len(times), 3, 3 * len(times)))
        later_ns, pose, factor = stamp_ns, np.zeros(3), np.zeros((3, 3 * len(times)))
        for k in range(len(times) - 1, -1, -1):
            motion = self._track.motion(int(times[k]), later_ns)
            back = inverse(motion.increment)
            by_pose, by_back = compose_jacobians(pose, back)
            sigma = np.sqrt(np.maximum(motion_variances(motion, self._odometry), 0.0))
            factor = by_pose @ factor
            factor[:, 3 * k : 3 * k + 3] = by_back @ _inverse_jacobian(motion.increment) * sigma
            pose = np.asarray(compose(pose, back))
            poses[k], factors[k], later_ns = pose, factor, int(times[k])
        joint = np.einsum('iam,jbm->iajb', factors, factors)
        moved = np.flatnonzero(times != stamp_ns)
        joint[moved, :, moved] += np.diag(jitter_variances(motion))
        return poses[place], joint[place][:, :, place]


def _inverse_jacobian(motion: FloatArray) -> FloatArray:
    """Derivative (3, 3) of a motion's inverse by the motion."""
    back = inverse(motion)
    jacobian = -np.eye(3)
    jacobian[:2, :2] = -rotation(motion[2]).T
    # d(R^T)/d(turn) = -J R^T, with J the turn by 90 degrees.
    jacobian[:2, 2] = [back[1], -back[0]]
    return jacobian
