"""
Features of panoramas and their matches.

SIFT (Lowe, IJCV 60(2), 2004) with the root of its histograms (Arandjelovic and Zisserman, CVPR
2012): it tolerates the change of scale and slant between places metres apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array, IndexArray
from landmark_nav.learning.relative_pose.epipolar import (
    center,
    RayPairs,
    RelativePoseConfig,
    turned,
)
from landmark_nav.types import FloatArray, Panorama

# Overlap at the seam, and margin to uncovered parts, pixels: the support of a descriptor.
_SEAM_PX, _MARGIN_PX = 48, 9
_CONTRAST = 0.01


@dataclass(frozen=True, eq=False)
class Features:
    """Directions in the base frame, (n, 3) as `Cylinder.rays` has them, and descriptors (n, d)."""

    rays: FloatArray
    descriptors: Float32Array

    def __len__(self) -> int:
        """Return the number of features."""
        return len(self.rays)


def find_features(panorama: Panorama, most: int) -> Features:
    """Find the strongest features of a panorama of a full turn."""
    grey, mask = cv2.cvtColor(panorama.image, cv2.COLOR_BGR2GRAY), panorama.mask
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
    return Features(panorama.cylinder.rays(pixels[kept]), np.asarray(root, dtype=np.float32))


def alike(one: Features, other: Features, max_ratio: float) -> IndexArray:
    """Pairs (m, 2) of mutually nearest features that pass the ratio test, most distinct first."""
    if min(len(one), len(other)) < 2:
        return np.empty((0, 2), dtype=np.intp)
    pairs, ratio, _ = _nearest(one.descriptors @ other.descriptors.T, max_ratio)
    return pairs[np.argsort(ratio, kind='stable')]


def _nearest(
    likeness: Float32Array, max_ratio: float
) -> tuple[IndexArray, Float32Array, Float32Array]:
    """Pairs (m, 2), their ratios (m,) and likeness (m,) of mutually nearest descriptors."""
    best, rows = likeness.argmax(1), np.arange(len(likeness))
    top = likeness[rows, best]
    mutual = likeness.argmax(0)[best] == rows
    likeness[rows, best] = -1.0
    second = np.maximum(likeness.max(1), 0.0)
    # The distance of unit vectors is sqrt(2 - 2 cosine).
    ratio = np.sqrt(np.maximum(1.0 - top, 0.0) / np.maximum(1.0 - second, 1e-9))
    kept = np.flatnonzero(mutual & (ratio < max_ratio))
    return np.stack([kept, best[kept]], 1), ratio[kept], top[kept]


# Half width of the band about the epipolar curve, in sigmas: poses are not yet exact, and may be
# displaced by things that moved.
_BAND, WIDE_BAND = 6.0, 12.0
# Least cosine of the descriptors of a match.
_LEAST_LIKENESS = 0.8
# Least and greatest range of a match, in lengths of the baseline.
_NEAREST, _FARTHEST = 0.15, 30.0


def matches_along(
    one: int,
    other: int,
    states: FloatArray,
    features: Sequence[Features],
    config: RelativePoseConfig,
    band_sigmas: float = _BAND,
) -> RayPairs:
    """Match the features of two views near their epipolar curves."""
    way = center(states[other]) - center(states[one])
    w, v = (turned(states[k], features[k].rays).astype(np.float32) for k in (one, other))
    way32 = way.astype(np.float32)
    by_w, by_v = np.cross(v, way32), np.cross(way32, w)
    off = by_v @ v.T
    across_w, across_v = (np.stack([-r[:, 1], r[:, 0], 0 * r[:, 0]], 1) for r in (w, v))
    variance = (across_w @ by_w.T) ** 2 + (by_v @ across_v.T) ** 2
    variance += by_w[:, 2] ** 2 + by_v[:, 2:] ** 2
    band = band_sigmas * config.direction_sigma_rad
    near = off**2 < band**2 * variance
    parallax = np.outer(w[:, 0], v[:, 1]) - np.outer(w[:, 1], v[:, 0])
    ahead = way32[0] * v[:, 1] - way32[1] * v[:, 0]
    ahead_there = way32[0] * w[:, 1] - way32[1] * w[:, 0]
    with np.errstate(divide='ignore', invalid='ignore'):
        length = float(np.hypot(way[0], way[1]))
        reach, reach_there = ahead / parallax, ahead_there[:, None] / parallax
        for distance in (reach, reach_there):
            near &= (distance > _NEAREST * length) & (distance < _FARTHEST * length)
    likeness = features[one].descriptors @ features[other].descriptors.T
    likeness[~near] = -1.0
    found, _, top = _nearest(likeness, config.max_ratio)
    found = found[top > _LEAST_LIKENESS]
    return RayPairs(one, other, features[one].rays[found[:, 0]], features[other].rays[found[:, 1]])
