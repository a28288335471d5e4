"""A camera whose principal point is not where its calibration has it."""

from __future__ import annotations

import numpy as np

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.types import FloatArray

__all__ = ['straightened']


def straightened(
    bearing_rad: FloatArray, pan_rad: FloatArray | float, lens: float
) -> tuple[FloatArray, FloatArray]:
    """
    Bearings (m,) as they were with the principal point in its place, and what it changes.

    A principal point that is off shifts all pixels alike: those in the middle of the picture by
    more of an angle than those at its sides. What is off in the middle, too, is the boresight.

    Parameters
    ----------
    bearing_rad : ndarray, shape (m,)
        As measured.
    pan_rad : float or ndarray, shape (m,)
        Where the camera looked.
    lens : float
        By how much pixels are too far left, over the focal length.

    Returns
    -------
    tuple of ndarray, shape (m,)
        Bearings and their derivative by `lens`.

    """
    # From the axis that goes with the true principal point.
    off_axis = bearing_rad - pan_rad + np.arctan(lens)
    sin, cos = np.sin(off_axis), np.cos(off_axis)
    shifted = sin - lens * cos
    by_lens = (1.0 / (1.0 + lens**2) - cos**2) / (cos**2 + shifted**2)
    if lens == 0.0:
        return bearing_rad, by_lens
    return wrap_rad(np.arctan2(shifted, cos) + pan_rad), by_lens
