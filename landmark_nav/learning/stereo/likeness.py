"""
Whether two views show one flat patch, all of it.

Where furniture stands against its wall, its rear corner lies on the wall, and a patch around it is
found there with high correlation, as the outline is what counts for it; but within the outline
each view shows another side. So the quarters of a patch are compared one by one.
"""

from __future__ import annotations

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array
from landmark_nav.types import FloatArray

__all__ = ['displaced_quarter']

# Against noise of pixels (Gaussian sigma).
_BLUR_PX = 0.8
# Least square of a quarter's gradients, as a share of the patch's: blank wall shows no place.
_BLANK = 0.02


def displaced_quarter(first: Float32Array, second: Float32Array) -> float:
    """
    How far a quarter of a patch would have to be out of place for two views to differ as they do.

    That is the deviation of the views, alike but for gain and offset, over their gradients. What
    all quarters have in common is noise, and does not count; neither does a quarter's brightness.

    Parameters
    ----------
    first, second : ndarray, shape (h, w)
        Both views, aligned and equally sharp.

    Returns
    -------
    float
        Pixels of the views; of the quarter where it is most.

    """
    one, two = (cv2.GaussianBlur(view - view.mean(), (0, 0), _BLUR_PX) for view in (first, second))
    one *= np.sum(one * two) / np.sum(one * one)
    slopes = [np.gradient(view) for view in (one, two)]
    power = _quarters(0.5 * np.sum(np.square(slopes), axis=(0, 1))).mean(1)
    unlike = _quarters(two - one).var(1)
    power += _BLANK * power.mean()
    return float(np.sqrt(np.max((unlike - unlike.min()) / power)))


def _quarters(image: Float32Array) -> FloatArray:
    """Four rows of the pixels of the quarters; middle rows and columns of odd sizes left out."""
    rows, columns = image.shape[0] // 2, image.shape[1] // 2
    return np.array(
        [
            part.ravel()
            for half in (image[:rows], image[-rows:])
            for part in (half[:, :columns], half[:, -columns:])
        ]
    )
