"""
Features of panoramas, and which of them look alike.

SIFT (Lowe, IJCV 60(2), 2004) with the root of its histograms (Arandjelovic and Zisserman, CVPR
2012): it bears the change of scale and slant between places metres apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from landmark_nav.arrays import BoolArray, Float32Array, IndexArray
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.types import FloatArray, ImageArray

# A feature looks so far around itself, pixels: round the seam, and away from what is uncovered.
_SEAM_PX, _MARGIN_PX = 48, 9
_CONTRAST = 0.01


@dataclass(frozen=True, eq=False)
class Features:
    """Directions in the base frame, (n, 3) as `Cylinder.rays` has them, and descriptors (n, d)."""

    rays: FloatArray
    descriptors: Float32Array

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.rays)


def find_features(grey: ImageArray, mask: BoolArray, cylinder: Cylinder, most: int) -> Features:
    """
    Find the strongest features of a panorama.

    Parameters
    ----------
    grey : ndarray of uint8, shape (height, width)
        Of a full turn: the last column borders on the first.
    mask : ndarray of bool, shape (height, width)
        What is covered.
    """
    width = grey.shape[1]
    columns = np.arange(-_SEAM_PX, width + _SEAM_PX) % width
    kernel = np.ones((_MARGIN_PX, _MARGIN_PX), np.uint8)
    inside = cv2.erode(np.ascontiguousarray(mask[:, columns], dtype=np.uint8), kernel)
    sift = cv2.SIFT_create(nfeatures=most, contrastThreshold=_CONTRAST)  # type: ignore[attr-defined]
    points, descriptors = sift.detectAndCompute(np.ascontiguousarray(grey[:, columns]), inside)
    if not points:
        return Features(np.empty((0, 3)), np.empty((0, 128), np.float32))
    pixels = np.array([point.pt for point in points]) - (_SEAM_PX, 0)
    kept = (pixels[:, 0] >= -0.5) & (pixels[:, 0] < width - 0.5)
    histograms = descriptors[kept]
    root = np.sqrt(histograms / np.maximum(histograms.sum(1, keepdims=True), 1e-9))
    return Features(cylinder.rays(pixels[kept]), np.asarray(root, dtype=np.float32))


def alike(one: Features, other: Features, max_ratio: float) -> IndexArray:
    """
    Pairs (m, 2) of features that are each other's nearest, and nearer than the next by far.

    The most distinct come first.
    """
    if min(len(one), len(other)) < 2:
        return np.empty((0, 2), dtype=np.intp)
    likeness = one.descriptors @ other.descriptors.T
    best = likeness.argmax(1)
    rows = np.arange(len(one))
    back = likeness.argmax(0)[best] == rows
    top = likeness[rows, best]
    likeness[rows, best] = -1.0
    with np.errstate(divide='ignore', invalid='ignore'):
        ratio = np.sqrt(np.maximum(1.0 - top, 0.0) / np.maximum(1.0 - likeness.max(1), 1e-9))
    kept = np.flatnonzero(back & (ratio < max_ratio))
    kept = kept[np.argsort(ratio[kept], kind='stable')]
    return np.stack([kept, best[kept]], 1)
