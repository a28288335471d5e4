"""From feature maps to one saliency map."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array

__all__ = ['conspicuity_map', 'fuse']

# A map that rises less has nothing in it but rounding.
_LEAST_PEAK = 1e-3


def conspicuity_map(
    feature: Float32Array, center_sigma: float, surround_sigma: float, side: int = 0
) -> Float32Array:
    """
    Where a feature stands out from its surround, in [0, 1].

    Difference of Gaussians, rectified, then N(m) = m (1 - mean of the local maxima)^2, which
    lets a map with one peak pass and suppresses one with many equal peaks. Itti, Koch and
    Niebur, A Model of Saliency-Based Visual Attention, PAMI 20(11), 1998.

    Parameters
    ----------
    feature : ndarray of float32, shape (height, width)
    center_sigma, surround_sigma : float
        In pixels of `feature`.
    side : int
        Columns at either end that are there twice, and count once.

    """
    turn = slice(side, feature.shape[1] - side)
    center = cv2.GaussianBlur(feature, (0, 0), center_sigma)
    surround = cv2.GaussianBlur(feature, (0, 0), surround_sigma)
    stands_out = np.maximum(center - surround, 0.0)
    peak = float(stands_out[:, turn].max())
    if peak < _LEAST_PEAK:
        return np.zeros_like(feature)
    stands_out /= np.float32(peak)
    reach = 2 * int(np.ceil(surround_sigma)) + 1
    highest = cv2.dilate(stands_out, np.ones((reach, reach), np.uint8))
    is_peak = (stands_out == highest) & (stands_out > 0.0)
    maxima = stands_out[:, turn][is_peak[:, turn]]
    others = float(maxima[maxima < 1.0].mean()) if np.any(maxima < 1.0) else 0.0
    return np.asarray(stands_out * np.float32((1.0 - others) ** 2), dtype=np.float32)


def fuse(conspicuities: Mapping[str, Float32Array], weights: Mapping[str, float]) -> Float32Array:
    """Weighted mean of conspicuity maps of the same shape."""
    total = sum(weights[name] for name in conspicuities)
    fused = sum(np.float32(weights[name] / total) * m for name, m in conspicuities.items())
    return np.asarray(fused, dtype=np.float32)
