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
    Return bearings (m,) corrected for an error of the principal point, and their derivatives.

    The error shifts all pixels alike, which is a larger angle in the middle of the image than at
    its sides. The angle in the middle is part of the boresight and is not corrected here.

    Parameters
    ----------
    bearing_rad : ndarray, shape (m,)
        As measured.
    pan_rad : float or ndarray, shape (m,)
        Where the camera looked.
    lens : float
        Shift of the pixels to the left over the focal length.

    Returns
    -------
    tuple of ndarray, shape (m,)
        Corrected bearings, and their derivatives by `lens`.

    """
    # From the axis that goes with the true principal point.
    off_axis = bearing_rad - pan_rad + np.arctan(lens)
    sin, cos = np.sin(off_axis), np.cos(off_axis)
    shifted = sin - lens * cos
    by_lens = (1.0 / (1.0 + lens**2) - cos**2) / (cos**2 + shifted**2)
    if lens == 0.0:
        return bearing_rad, by_lens
    return wrap_rad(np.arctan2(shifted, cos) + pan_rad), by_lens
