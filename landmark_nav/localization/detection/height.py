"""What the rows of matches tell, which triangulation does not use: mistakes, and a lean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import CameraModel
from landmark_nav.types import FloatArray

__all__ = [
    'CAMERA_HEIGHT_SIGMA_M',
    'TILTED_RAD',
    'CameraTilt',
    'RowModel',
    'RowResiduals',
    'estimate_camera_tilt',
    'wrong_heights',
]

# The camera hangs so much higher or lower than was measured with a tape.
CAMERA_HEIGHT_SIGMA_M = 0.01

# With fewer matches a wrong height cannot be distinguished from a wrong tilt.
_LEAST_HEIGHTS = 3
# Step of numerical differentiation, metres or radians.
_STEP = 1e-4
# A match is at a wrong height if it is so many sigmas off, given the others.
_WRONG = 4.0
# A tilt or a roll is a knock if it is more than an uneven floor causes.
TILTED_RAD = 0.005
# Sigma of a tilt and a roll of which nothing is known.
_ANY_RAD = 0.1
# A roll is sure if it is so many sigmas off, of so many matches, if so large a share of all agree,
# and whichever of them are left out that are so near to each other: posters are exchanged whole.
_SURE, _LEAST_SURE, _MOST, _NEAR_M = 3.0, 4, 0.6, 0.5


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
        common = np.column_stack([by_shared, CAMERA_HEIGHT_SIGMA_M * self.by_height])
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

    @property
    def may_tell_a_roll(self) -> bool:
        """Whether they are as far apart as a roll that is a knock sets them; quick to tell."""
        if len(self.off_px) < _LEAST_SURE:
            return False
        by_roll = self.by_tilt_roll[:, 1]
        apart_px = self.off_px.max() - self.off_px.min()
        return bool(apart_px > TILTED_RAD * (by_roll.max() - by_roll.min()))

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


class CameraTilt(NamedTuple):
    """
    By how much a camera's tilt is larger, and it leans to its right, than was assumed; radians.

    `matches` is how many tell so, wrong heights left out; `roll_sigma_rad` is the roll's sigma;
    `sure` tells whether they are most of all, and whether those say so as well that are left
    without any one thing on a wall.
    """

    tilt_rad: float = 0.0
    roll_rad: float = 0.0
    roll_sigma_rad: float = np.inf
    matches: int = 0
    sure: bool = False

    @property
    def is_roll(self) -> bool:
        """Whether there surely is a roll, and more than an uneven floor causes."""
        return self.sure and abs(self.roll_rad) > TILTED_RAD


def estimate_camera_tilt(heights: RowResiduals) -> CameraTilt:
    """Estimate tilt and roll of a camera of which nothing is known, without wrong heights."""
    fits = ~heights.wrong(_ANY_RAD)
    count = int(fits.sum())
    if count < _LEAST_HEIGHTS:
        return CameraTilt()
    off_px, by_tilt_roll, covariance, points = heights.chosen(fits)
    inverse = np.linalg.inv(covariance)
    weighted = inverse @ by_tilt_roll
    information, projected = by_tilt_roll.T @ weighted + np.eye(2) / _ANY_RAD**2, off_px @ weighted
    (tilt, roll), sigma = _solved(information, projected)
    sure = count >= max(_LEAST_SURE, _MOST * len(fits)) and abs(roll) > _SURE * sigma
    if sure:
        near = np.linalg.norm(points[:, None] - points, axis=-1) < _NEAR_M
        for out in np.unique(near, axis=0):
            # Least squares without some rows differ from those with all by their rank.
            less = np.linalg.solve(inverse[np.ix_(out, out)], weighted[out]).T
            (_, without), doubt = _solved(
                information - less @ weighted[out], projected - less @ (inverse @ off_px)[out]
            )
            sure &= bool(without * np.sign(roll) > _SURE * doubt)
    return CameraTilt(float(tilt), float(roll), float(sigma), count, sure)


def _solved(information: FloatArray, projected: FloatArray) -> tuple[FloatArray, float]:
    """Tilt and roll (2,) of least squares, and the sigma of the roll."""
    spread = np.linalg.inv(information)
    return spread @ projected, float(np.sqrt(spread[1, 1]))


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
