"""
How far off templates may be that were aligned with images.

White noise of variance s^2 in the search image passes the blur and the interpolation, together B,
so the shift's covariance is ``s^2 N^-1 G B B^T G^T N^-1`` with G the gradients and N their normal
matrix; the residuals, whose variance is s^2 times the sum of the squares of B's kernel, give s^2.

Where things stand out from each other (an image's frame, a reflection), residuals next to each
other pull alike. So each part of the patch says where it would rather be, and where they
contradict each other by more than noise does, their spread is the covariance: the sandwich with
clusters (White, Econometrica 48(4), 1980; Liang and Zeger, Biometrika 73(1), 1986).
"""

from __future__ import annotations

from functools import lru_cache
import math
from typing import NamedTuple

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array, FloatArray
from landmark_nav.matching.blur import MATCHED_PX, Pair

__all__ = ['Fits', 'covariances']

# Covariance that remains if noise did not matter: interpolation, and texture that isn't quite the
# same, pixels.
_FLOOR = np.diag([0.02**2, 0.02**2])
# Parts of a patch, each way, that may be out of place. Shift, gain and offset take of their
# freedom, and that few contribute to a variance raises the mean of what is divided by it: two
# more.
_PARTS, _TAKEN = 4, 4 + 2
# By this share the variance estimated from parts exceeds that of white noise once in ten cases.
_BY_CHANCE = 0.5
_TINY = 1e-12


class Fits(NamedTuple):
    """
    What gives the accuracy of n aligned templates.

    `sizes` are width and height; `rows` (5, pixels) each, of which the first two are twice the
    gradients and the third the template; `seen` (pixels,) each what the image shows, without its
    mean; `xy` (n, 2) the centres; `gain` (n,); `left` (n,) the sum of the squares of what gain
    and shift don't explain; `by_gain` (n, 2) what gain explains of the gradients; `inverse`
    (n, 2, 2) of the normal matrices; `blurs` those of the search images, before.
    """

    sizes: list[tuple[int, int]]
    rows: list[Float32Array]
    seen: list[Float32Array]
    xy: FloatArray
    gain: FloatArray
    left: FloatArray
    by_gain: FloatArray
    inverse: FloatArray
    blurs: list[Pair]


def covariances(fits: Fits) -> FloatArray:
    """Covariances (n, 2, 2) of the centres."""
    n = len(fits.rows)
    away = np.zeros((n, 2, 3), np.float32)
    away[:, :, :2], away[:, :, 2] = np.eye(2), -fits.by_gain
    gradients = [each @ rows[:3] for each, rows in zip(away, fits.rows, strict=True)]
    corners = fits.xy - 0.5 * (np.array(fits.sizes) - 1)
    fractions = np.round(corners % 1.0, 1).tolist()
    passed = np.array(
        [
            _noise_passed(*each)
            for each in zip(gradients, fits.sizes, fractions, fits.blurs, strict=True)
        ]
    )
    pulls = [
        gradient * (seen / gain - rows[2])
        for gradient, seen, gain, rows in zip(
            gradients, fits.seen, fits.gain.astype(np.float32), fits.rows, strict=True
        )
    ]
    by_parts = np.array([_summed_squares(*each) for each in zip(pulls, fits.sizes, strict=True)])
    freedom = np.array([max(seen.size - 4, 1) for seen in fits.seen])
    variance = fits.left / freedom / fits.gain**2
    # The gradients are twice what they are called.
    covariance = 0.25 * variance[:, None, None] * (fits.inverse @ passed @ fits.inverse)
    unlike = 0.25 * (fits.inverse @ by_parts @ fits.inverse)
    noise = np.maximum(np.diagonal(covariance, axis1=1, axis2=2), _TINY)
    further = np.diagonal(unlike, axis1=1, axis2=2) / noise - _BY_CHANCE
    wider = np.sqrt(np.maximum(further, 1.0))
    return np.asarray(covariance * wider[:, :, None] * wider[:, None] + _FLOOR)


def _noise_passed(
    gradients: Float32Array,
    size: tuple[int, int],
    fraction: tuple[float, float],
    search_blur: Pair,
) -> FloatArray:
    """``G B B^T G^T`` (2, 2) over the sum of the squares of B's kernel; gradients (2, pixels)."""
    width, height = size
    across = _noise_correlation(round(search_blur[0], 1), fraction[0], width)
    down = _noise_correlation(round(search_blur[1], 1), fraction[1], height)
    passed = down @ gradients.reshape(2, height, width) @ across
    return np.asarray(gradients @ passed.reshape(2, -1).T, dtype=np.float64)


def _noise_correlation(blur_px: float, fraction: float, count: int) -> Float32Array:
    """Correlation (count, count) of the noise of so many pixels in a row, as a match sees it."""
    # In sizes of powers of two, and tenths: most of them are asked for again.
    return _correlations(blur_px, fraction, 1 << (count - 1).bit_length())[:count, :count]


@lru_cache(maxsize=256)
def _correlations(blur_px: float, fraction: float, count: int) -> Float32Array:
    # Blur, here and before, and interpolation at a fraction of a pixel, one after the other.
    sigma = math.hypot(MATCHED_PX, blur_px)
    reach = int(np.ceil(3.0 * sigma)) + 1
    gauss = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = np.convolve(gauss, [1.0 - fraction, fraction])
    shared = np.zeros(count + len(kernel))
    shared[: len(kernel)] = np.correlate(kernel, kernel, 'full')[len(kernel) - 1 :]
    place = np.arange(count)
    apart = np.abs(place[:, None] - place)
    return np.asarray(shared[apart] / shared[0], dtype=np.float32)


def _summed_squares(pulls: Float32Array, size: tuple[int, int]) -> FloatArray:
    """Sum (2, 2) over parts of a patch of the squares of what pulls (2, pixels) come to there."""
    width, height = size
    stacked = pulls.reshape(2 * height, width)
    means = cv2.resize(stacked, (_PARTS, 2 * _PARTS), interpolation=cv2.INTER_AREA).reshape(2, -1)
    count = means.shape[1]
    in_each = width * height / count
    free = in_each**2 * count / (count - _TAKEN)
    return np.asarray(free * (means @ means.T), dtype=np.float64)
