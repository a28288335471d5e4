"""What the rows of matches tell, which triangulation does not use: mistakes, and a lean."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import CameraModel
from landmark_nav.types import FloatArray

__all__ = ['LEAST_HEIGHTS', 'Lean', 'RowModel', 'told_lean', 'wrong_heights']

# With fewer matches a wrong height cannot be told from a wrong tilt.
LEAST_HEIGHTS = 3
# Step of numerical differentiation, metres or radians.
_STEP = 1e-4
# A match is at a wrong height if it is so many sigmas off, given the others.
_WRONG = 4.0
# Sigma of a tilt and a roll of which nothing is known.
_ANY_RAD = 0.1
# A roll is sure if it is so many sigmas off, whichever of so many matches is left out.
_SURE, _LEAST_SURE = 3.0, 4


class RowModel(NamedTuple):
    """
    Rows of points (n,) of the picture, differentiated.

    `by_pose` (n, 3) by the pose of the base, px/m and px/rad; `by_lean` (n, 2) by tilt and roll of
    the camera, px/rad; `by_height` (n,) by the point's own height, px/m.
    """

    by_pose: FloatArray
    by_lean: FloatArray
    by_height: FloatArray

    @classmethod
    def of(
        cls,
        points_map: FloatArray,
        pose_map_base: FloatArray,
        rotation: FloatArray,
        center: FloatArray,
        camera: CameraModel,
    ) -> RowModel:
        """Of points (n, 3) and a camera at `center` (3,), turned by `rotation` optical -> map."""
        points = (points_map - center) @ rotation
        away = points_map - [*pose_map_base[:2], 0.0]
        # As the camera sees them, points move against the base.
        moved = np.zeros((7, *points.shape))
        moved[1, :, 0] = moved[2, :, 1] = -_STEP
        moved[3, :, 0], moved[3, :, 1] = _STEP * away[:, 1], -_STEP * away[:, 0]
        moved[6, :, 2] = _STEP
        moved = moved @ rotation
        moved[4, :, 1], moved[4, :, 2] = _STEP * points[:, 2], -_STEP * points[:, 1]
        moved[5, :, 0], moved[5, :, 1] = _STEP * points[:, 1], -_STEP * points[:, 0]
        rows = camera.project(points + moved)[..., 1]
        by = ((rows[1:] - rows[0]) / _STEP).T
        return cls(by[:, :3], by[:, 3:5], by[:, 5])

    def covariance(self, pose_covariance: FloatArray) -> FloatArray:
        """Covariance (n, n) of the rows by errors of the pose."""
        return np.asarray(self.by_pose @ pose_covariance @ self.by_pose.T)


class Lean(NamedTuple):
    """
    By how much a camera looks higher, and leans to its right, than was assumed; radians.

    `roll_sigma_rad` is the standard deviation of the roll. `sure` tells whether all matches but
    any one say that there is a roll.
    """

    tilt_rad: float = 0.0
    roll_rad: float = 0.0
    roll_sigma_rad: float = np.inf
    sure: bool = False


def told_lean(off_px: FloatArray, by_lean: FloatArray, covariance: FloatArray) -> Lean:
    """
    Estimate tilt and roll of a camera of which nothing is known.

    Parameters
    ----------
    off_px : ndarray, shape (n,)
        Rows found minus rows expected.
    by_lean : ndarray, shape (n, 2)
        Their derivatives by tilt and roll, as in `RowModel`.
    covariance : ndarray, shape (n, n)
        Of these differences, by anything else.

    """
    fits = ~wrong_heights(off_px, covariance + _ANY_RAD**2 * by_lean @ by_lean.T)
    off_px, by_lean, covariance = off_px[fits], by_lean[fits], covariance[np.ix_(fits, fits)]
    (tilt, roll), sigma = _lean(off_px, by_lean, covariance)
    sure = len(off_px) >= _LEAST_SURE and abs(roll) > _SURE * sigma
    for k in range(len(off_px) if sure else 0):
        left = np.arange(len(off_px)) != k
        (_, without), doubt = _lean(off_px[left], by_lean[left], covariance[np.ix_(left, left)])
        sure &= bool(without * np.sign(roll) > _SURE * doubt)
    return Lean(tilt, roll, sigma, sure)


def _lean(
    off_px: FloatArray, by_lean: FloatArray, covariance: FloatArray
) -> tuple[list[float], float]:
    """Tilt and roll of least squares, and the sigma of the roll."""
    weighted = np.linalg.solve(covariance, by_lean)
    spread = np.linalg.inv(by_lean.T @ weighted + np.eye(2) / _ANY_RAD**2)
    return (spread @ (off_px @ weighted)).tolist(), float(np.sqrt(spread[1, 1]))


def wrong_heights(off_px: FloatArray, covariance: FloatArray) -> npt.NDArray[np.bool_]:
    """
    Find the matches whose height in the picture contradicts the others'.

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
    while len(left) >= LEAST_HEIGHTS:
        inverse = np.linalg.inv(covariance[np.ix_(left, left)])
        sigmas = np.abs(inverse @ off_px[left]) / np.sqrt(np.diag(inverse))
        worst = int(np.argmax(sigmas))
        if sigmas[worst] < _WRONG:
            break
        wrong[left[worst]] = True
        left = np.delete(left, worst)
    return wrong
