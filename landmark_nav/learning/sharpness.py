"""
How sharp an image is beside others that show the same part of the room.

Sharpness alone shows nothing: a blank wall has none. So gradients are kept by direction, and two
images are compared where both look, whatever is there.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.types import FloatArray, ImageArray

__all__ = ['Look', 'look_at', 'relative_sharpness']

_BIN_RAD = float(np.radians(1.0))
# Common directions that a comparison needs.
_LEAST_BINS = 4
# An image whose grey levels span no more shows nothing: covered, dark, or overexposed.
_FLAT_LEVELS = 2
# Energy that counts as little: what noise of two or three grey levels makes.
_NOTHING = 5e-3


@dataclass(frozen=True, eq=False)
class Look:
    """
    What an image shows, as far as its quality goes.

    `azimuth_rad` (n,) rises evenly and is relative to the pan; `energy` (2, n) is the mean squared
    gradient there, across and down, over the squared mean brightness; `flat` says that there is no
    contrast at all.
    """

    azimuth_rad: FloatArray
    energy: FloatArray
    flat: bool


def look_at(image: ImageArray, camera: CameraModel, camera_roll_rad: float = 0.0) -> Look:
    """
    Measure an image, BGR (height, width, 3) or grey (height, width), of a camera that is rolled.

    The gradient is Sobel's, as in Tenenbaum's measure of focus (Krotkov, IJCV 1, 1987).

    """
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    low, high = cv2.minMaxLoc(grey)[:2]
    slopes = [cv2.Sobel(grey, cv2.CV_32F, *axes) for axes in ((1, 0), (0, 1))]
    columns = [cv2.reduce(slope * slope, 0, cv2.REDUCE_AVG).ravel() for slope in slopes]
    brightness = cv2.reduce(grey, 0, cv2.REDUCE_AVG, dtype=cv2.CV_32F).ravel()

    pixels = np.stack([np.arange(camera.width), np.full(camera.width, camera.cy)], -1)
    # About the pan axis, however that is mounted.
    turn, _ = PanTiltMount(camera_roll_rad=camera_roll_rad).camera_pose_base(0.0)
    rays = camera.unproject(pixels) @ turn.T
    azimuth = np.unwrap(np.arctan2(rays[:, 1], rays[:, 0]))
    bins = np.floor(azimuth / _BIN_RAD).astype(int)
    first, count = bins.min(), np.bincount(bins - bins.min())
    across, down, light = (
        np.bincount(bins - first, values) / np.maximum(count, 1)
        for values in (*columns, brightness)
    )
    return Look(
        (first + np.arange(len(count)) + 0.5) * _BIN_RAD,
        np.stack([across, down]) / np.maximum(light, 1.0) ** 2,
        bool(high - low <= _FLAT_LEVELS),
    )


def relative_sharpness(look: Look, other: Look, turned_rad: float) -> float | None:
    """
    Gradient energy of one image over that of another in the directions that both show.

    Across or down, whichever is less: a shaken camera blurs one way only. Each is the median over
    directions, by how much there is to see there: people who pass hardly count.

    Parameters
    ----------
    look, other : Look
        Of both.
    turned_rad : float
        Pan of the first less that of the other.

    Returns
    -------
    float or None
        About 1 if both are equally sharp; None if they have too little in common.

    """
    at = look.azimuth_rad + turned_rad
    both = (at >= other.azimuth_rad[0]) & (at <= other.azimuth_rad[-1])
    if np.count_nonzero(both) < _LEAST_BINS:
        return None
    ratios = []
    for own, its in zip(look.energy, other.energy, strict=True):
        here, there = own[both] + _NOTHING, np.interp(at[both], other.azimuth_rad, its) + _NOTHING
        ratios.append(_weighted_median(here / there, np.sqrt(here * there)))
    return min(ratios)


def _weighted_median(values: FloatArray, weights: npt.NDArray[np.float64]) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
