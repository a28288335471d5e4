"""Residuals of the rows of matches: an inconsistent row shows a false match."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from landmark_nav.geometry.camera import CameraModel
from landmark_nav.types import FloatArray

# Sigma of the camera's height, m.
_CAMERA_HEIGHT_SIGMA_M = 0.01
# With fewer matches a wrong height cannot be distinguished from a wrong tilt.
_LEAST_HEIGHTS = 3
# Step of numerical differentiation, metres or radians.
_STEP = 1e-4
# A match has a wrong height if its residual, given the others, exceeds this number of sigmas.
_WRONG = 4.0


class RowModel(NamedTuple):
    """
    Derivatives of the image rows of points (n,).

    `by_pose` (n, 3) is by the pose of the base, px/m and px/rad; `by_tilt_roll` (n, 2) by tilt and
    roll of the camera, px/rad; `by_height` (n,) by the height of the point, px/m.
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
        Differentiate rows of points (n, 3) in a camera at `center` (3,).

        `rotation` is optical -> map; `roll_rad` is the roll of the camera on its tilt joint.
        """
        points = (points_map - center) @ rotation
        away = points_map - [*pose_map_base[:2], 0.0]
        # In the frame of the camera, points move opposite to the base.
        moved = np.zeros((7, *points.shape))
        moved[1, :, 0] = moved[2, :, 1] = -_STEP
        moved[3, :, 0], moved[3, :, 1] = _STEP * away[:, 1], -_STEP * away[:, 0]
        moved[6, :, 2] = _STEP
        moved = moved @ rotation
        # The axis of the tilt joint; for a camera mounted upright it is the x axis of the image.
        right, down, ahead = points.T
        axis_right, axis_down = np.cos(roll_rad), -np.sin(roll_rad)
        moved[4, :, 0], moved[4, :, 1] = -_STEP * (ahead * axis_down), _STEP * (ahead * axis_right)
        moved[4, :, 2] = _STEP * (right * axis_down - down * axis_right)
        moved[5, :, 0], moved[5, :, 1] = _STEP * down, -_STEP * right
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
            Covariance of the base's pose.
        points : ndarray, shape (n, 3, 3)
            Covariance of each point.
        shared : ndarray, shape (n, 3, F)
            Loadings of the shared map factors.
        """
        by_point = np.column_stack([-self.by_pose[:, :2], self.by_height])[:, None]
        by_shared = (by_point @ shared)[:, 0]
        own = (by_point @ points @ by_point.swapaxes(1, 2))[:, 0, 0] - np.sum(by_shared**2, axis=1)
        # Unlike a tilt, the camera's height shifts near points more than far ones.
        common = np.column_stack([by_shared, _CAMERA_HEIGHT_SIGMA_M * self.by_height])
        by_pose = self.by_pose @ pose_covariance @ self.by_pose.T
        return np.asarray(by_pose + common @ common.T + np.diag(own))


class RowResiduals(NamedTuple):
    """
    Residuals of the rows of matches in images of one camera.

    Parameters
    ----------
    off_px : ndarray, shape (n,)
        Rows found minus rows expected.
    by_tilt_roll : ndarray, shape (n, 2)
        Their derivatives by tilt and roll of the camera, px/rad.
    covariance : ndarray, shape (n, n)
        Covariance of `off_px` by all errors but tilt and roll.
    points : ndarray, shape (n, 3)
        Positions of the landmarks in map, metres.
    """

    off_px: FloatArray
    by_tilt_roll: FloatArray
    covariance: FloatArray
    points: FloatArray

    @staticmethod
    def joined(parts: Sequence[RowResiduals]) -> RowResiduals:
        """Combine the residuals of several images, with independent errors."""
        off_px, by_tilt_roll, covariances, points = zip(*parts, strict=True)
        return RowResiduals(
            np.concatenate(off_px),
            np.concatenate(by_tilt_roll),
            block_diag(*covariances),
            np.concatenate(points),
        )

    def wrong(self, tilt_roll_rad: float) -> npt.NDArray[np.bool_]:
        """Which matches (n,) are inconsistent with the others, for a sigma of tilt and roll."""
        by_tilt_roll = tilt_roll_rad * self.by_tilt_roll
        return wrong_heights(self.off_px, self.covariance + by_tilt_roll @ by_tilt_roll.T)

    def chosen(self, keep: npt.NDArray[np.bool_]) -> RowResiduals:
        """Return the residuals selected by `keep` (n,)."""
        return RowResiduals(
            self.off_px[keep],
            self.by_tilt_roll[keep],
            self.covariance[np.ix_(keep, keep)],
            self.points[keep],
        )


def wrong_heights(off_px: FloatArray, covariance: FloatArray) -> npt.NDArray[np.bool_]:
    """
    Find the matches whose row in the image is inconsistent with the others.

    Errors of pose, tilt and roll are common to all, as `covariance` describes. The residual of a
    match given the others is its own error; the worst match is removed while it is too large
    (Baarda, A Testing Procedure for Use in Geodetic Networks, 1968).

    Parameters
    ----------
    off_px : ndarray, shape (n,)
        Rows found minus rows expected.
    covariance : ndarray, shape (n, n)
        Covariance of these differences.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    wrong = np.zeros(len(off_px), dtype=np.bool_)
    left = np.arange(len(off_px))
    while len(left) >= _LEAST_HEIGHTS:
        inverse = np.linalg.inv(covariance[left][:, left])
        sigmas = np.abs(inverse @ off_px[left]) / np.sqrt(np.diag(inverse))
        worst = int(np.argmax(sigmas))
        if sigmas[worst] < _WRONG:
            break
        wrong[left[worst]] = True
        left = np.delete(left, worst)
    return wrong
