"""Rows of matches beside those that were expected: a wrong one is a mistaken match."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import CameraModel
from landmark_nav.types import FloatArray

# The camera hangs so much higher or lower than was measured with a tape.
_CAMERA_HEIGHT_SIGMA_M = 0.01

# With fewer matches a wrong height cannot be distinguished from a wrong tilt.
_LEAST_HEIGHTS = 3
# Step of numerical differentiation, metres or radians.
_STEP = 1e-4
# A match is at a wrong height if it is so many sigmas off, given the others.
_WRONG = 4.0


class RowModel(NamedTuple):
    """
    Rows of points (n,) of the image, differentiated.

    `by_pose` (n, 3) by the pose of the base, px/m and px/rad; `by_tilt_roll` (n, 2) by tilt and
    roll of the camera, px/rad; `by_height` (n,) by the point's own height, px/m.
    """

    by_pose: FloatArray
    by_tilt_roll: FloatArray
    by_height: FloatArray

    @classmethod
    def of(
        cls,
        points_map: FloatArray,
        pose_map_base: FloatArray,
        rotation: FloatArray,
        center: FloatArray,
        camera: CameraModel,
        roll_rad: float,
    ) -> RowModel:
        """
        Of points (n, 3) and a camera at `center` (3,), turned by `rotation` optical -> map.

        `roll_rad` is that of the camera on its tilt joint.
        """
        points = (points_map - center) @ rotation
        away = points_map - [*pose_map_base[:2], 0.0]
        # As the camera sees them, points move against the base.
        moved = np.zeros((7, *points.shape))
        moved[1, :, 0] = moved[2, :, 1] = -_STEP
        moved[3, :, 0], moved[3, :, 1] = _STEP * away[:, 1], -_STEP * away[:, 0]
        moved[6, :, 2] = _STEP
        moved = moved @ rotation
        # The joint's axis, which is the image's own where the camera is mounted upright.
        by_tilt = np.array([np.cos(roll_rad), -np.sin(roll_rad), 0.0])
        moved[4] = _STEP * np.cross(points, by_tilt)
        moved[5, :, 0], moved[5, :, 1] = _STEP * points[:, 1], -_STEP * points[:, 0]
        rows = camera.project(points + moved)[..., 1]
        by = ((rows[1:] - rows[0]) / _STEP).T
        return cls(by[:, :3], by[:, 3:5], by[:, 5])

    def covariance(
        self, pose_covariance: FloatArray, points: FloatArray, shared: FloatArray
    ) -> FloatArray:
        """
        Covariance (n, n) of the rows by errors of pose, camera height and points.

        Parameters
        ----------
        pose_covariance : ndarray, shape (3, 3)
            Of the base.
        points : ndarray, shape (n, 3, 3)
            Covariance of each point.
        shared : ndarray, shape (n, 3, F)
            Loadings of the part that they have in common.
        """
        by_point = np.column_stack([-self.by_pose[:, :2], self.by_height])[:, None]
        by_shared = (by_point @ shared)[:, 0]
        own = (by_point @ points @ by_point.swapaxes(1, 2))[:, 0, 0] - np.sum(by_shared**2, axis=1)
        # Unlike a tilt, a height shifts what is near more than what is far.
        common = np.column_stack([by_shared, _CAMERA_HEIGHT_SIGMA_M * self.by_height])
        by_pose = self.by_pose @ pose_covariance @ self.by_pose.T
        return np.asarray(by_pose + common @ common.T + np.diag(own))


class RowResiduals(NamedTuple):
    """
    Rows of matches in images of one camera.

    Parameters
    ----------
    off_px : ndarray, shape (n,)
        Rows found minus rows expected.
    by_tilt_roll : ndarray, shape (n, 2)
        Their derivatives by tilt and roll of the camera, px/rad.
    covariance : ndarray, shape (n, n)
        Of `off_px`, by anything but tilt and roll.
    points : ndarray, shape (n, 3)
        Where the landmarks are in map, metres.
    """

    off_px: FloatArray
    by_tilt_roll: FloatArray
    covariance: FloatArray
    points: FloatArray

    @staticmethod
    def joined(parts: Sequence[RowResiduals]) -> RowResiduals:
        """Those of several images, whose errors are taken to have nothing in common."""
        off_px = np.concatenate([np.empty(0), *(part.off_px for part in parts)])
        by_tilt_roll = np.concatenate([np.empty((0, 2)), *(part.by_tilt_roll for part in parts)])
        points = np.concatenate([np.empty((0, 3)), *(part.points for part in parts)])
        covariance = np.zeros((len(off_px), len(off_px)))
        first = 0
        for part in parts:
            rows = slice(first, first := first + len(part.off_px))
            covariance[rows, rows] = part.covariance
        return RowResiduals(off_px, by_tilt_roll, covariance, points)

    def wrong(self, tilt_roll_rad: float) -> npt.NDArray[np.bool_]:
        """Which matches (n,) contradict the others, with this sigma of tilt and roll."""
        by_tilt_roll = tilt_roll_rad * self.by_tilt_roll
        return wrong_heights(self.off_px, self.covariance + by_tilt_roll @ by_tilt_roll.T)

    def chosen(self, keep: npt.NDArray[np.bool_]) -> RowResiduals:
        """Return some of them."""
        return RowResiduals(
            self.off_px[keep],
            self.by_tilt_roll[keep],
            self.covariance[np.ix_(keep, keep)],
            self.points[keep],
        )


def wrong_heights(off_px: FloatArray, covariance: FloatArray) -> npt.NDArray[np.bool_]:
    """
    Find the matches whose height in the image contradicts the others'.

    Errors of pose, tilt and roll move all of them together, as `covariance` has it. What remains
    of one match, given the others, is its own error; the worst is taken out as long as it is too
    large (Baarda, A Testing Procedure for Use in Geodetic Networks, 1968).

    Parameters
    ----------
    off_px : ndarray, shape (n,)
        Rows found minus rows expected.
    covariance : ndarray, shape (n, n)
        Of these differences.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    wrong = np.zeros(len(off_px), dtype=np.bool_)
    left = np.arange(len(off_px))
    while len(left) >= _LEAST_HEIGHTS:
        inverse = np.linalg.inv(covariance[np.ix_(left, left)])
        sigmas = np.abs(inverse @ off_px[left]) / np.sqrt(np.diag(inverse))
        worst = int(np.argmax(sigmas))
        if sigmas[worst] < _WRONG:
            break
        wrong[left[worst]] = True
        left = np.delete(left, worst)
    return wrong
