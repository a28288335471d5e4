"""Tilt and roll of a camera, out of the rows of the landmarks that it shows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from landmark_nav.localization.detection.rows import RowResiduals
from landmark_nav.types import FloatArray

__all__ = ['CameraTilt', 'estimate_camera_tilt']

# With fewer matches a wrong height cannot be distinguished from a wrong tilt.
_LEAST_HEIGHTS = 3
# A roll is a knock if it is more than an uneven floor causes, rad.
_TILTED_RAD = 0.005
# Sigma of a tilt and a roll of which nothing is known.
_ANY_RAD = 0.1
# A roll is certain if it is so many sigmas off, of so many matches, if so large a share of all
# agree, and whichever of them are left out that are so near to each other: posters are exchanged
# whole.
_SURE, _LEAST_SURE, _MOST, _NEAR_M = 3.0, 4, 0.6, 0.5


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
        return self.sure and abs(self.roll_rad) > _TILTED_RAD


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
