"""
Features of panoramas and their matches.

SIFT (Lowe, IJCV 60(2), 2004) with the root of its histograms (Arandjelovic and Zisserman, CVPR
2012): it tolerates the change of scale and slant between places metres apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import Float32Array, IndexArray
from landmark_nav.geometry.se2 import cross
from landmark_nav.learning.relative_pose.epipolar import (
    center,
    DIRECTION_SIGMA_RAD,
    RayPairs,
    turned,
)
from landmark_nav.types import FloatArray, Panorama

# Half width of the band about the epipolar curve, in sigmas: poses are not yet exact, and may be
# displaced by things that moved.
BAND, WIDE_BAND = 6.0, 12.0
# Overlap at the seam, and margin to uncovered parts, pixels: the support of a descriptor.
_SEAM_PX, _MARGIN_PX = 48, 9
_MOST_FEATURES, _CONTRAST = 6000, 0.01
# Greatest distance of a match in descriptor space, relative to that of the next best.
_MAX_RATIO = 0.85
# OpenCV doubles images so that all keypoints are too far to the right and down by this, pixels;
# its remedy, `enable_precise_upscale`, is not in all versions.
_DOUBLED_PX = 0.25
# Least cosine of the descriptors of a match, and of those that compete with it; number of
# features that are compared with all others at once.
_LEAST_LIKENESS, _ROWS = 0.78, 512
# Features nearer to each other are at one place, and no rivals.
_ONE_PLACE_RAD = 0.01
# Least and greatest range of a match, in lengths of the baseline.
_NEAREST, _FARTHEST = 0.15, 30.0


@dataclass(frozen=True, eq=False)
class Features:
    """
    Directions in the base frame, (n, 3) as `Cylinder.rays` has them, and descriptors (n, d).

    The strongest come first.
    """

    rays: FloatArray
    descriptors: Float32Array

    def __len__(self) -> int:
        """Return the number of features."""
        return len(self.rays)


def find_features(panorama: Panorama) -> Features:
    """Find the strongest features of a panorama of a full turn."""
    grey, mask = cv2.cvtColor(panorama.image, cv2.COLOR_BGR2GRAY), panorama.mask
    width = grey.shape[1]
    columns = np.arange(-_SEAM_PX, width + _SEAM_PX) % width
    kernel = np.ones((_MARGIN_PX, _MARGIN_PX), np.uint8)
    inside = cv2.erode(np.ascontiguousarray(mask[:, columns], dtype=np.uint8), kernel)
    sift = cv2.SIFT_create(nfeatures=_MOST_FEATURES, contrastThreshold=_CONTRAST)  # type: ignore[attr-defined]
    points, descriptors = sift.detectAndCompute(np.ascontiguousarray(grey[:, columns]), inside)
    if not points:
        return Features(np.empty((0, 3)), np.empty((0, 128), np.float32))
    pixels = np.array([point.pt for point in points]) - _DOUBLED_PX - (_SEAM_PX, 0)
    kept = np.argsort([-point.response for point in points], kind='stable')
    kept = kept[(pixels[kept, 0] >= -0.5) & (pixels[kept, 0] < width - 0.5)]
    histograms = descriptors[kept]
    root = np.sqrt(histograms / np.maximum(histograms.sum(1, keepdims=True), 1e-9))
    return Features(panorama.cylinder.rays(pixels[kept]), np.asarray(root, dtype=np.float32))


@dataclass(frozen=True, eq=False)
class LikePairs:
    """
    Pairs of features of two panoramas with similar descriptors.

    `rays` and `other_rays` are those of the features of each panorama, `first` and `second` (m,)
    indices into them, in ascending order of `first`; `likeness` (m,) is the cosine of both
    descriptors.
    """

    rays: FloatArray
    other_rays: FloatArray
    first: npt.NDArray[np.unsignedinteger]
    second: npt.NDArray[np.unsignedinteger]
    likeness: Float32Array

    def chosen(self, which: IndexArray) -> LikePairs:
        """Return the pairs of these numbers."""
        parts = self.first[which], self.second[which], self.likeness[which]
        return LikePairs(self.rays, self.other_rays, *parts)

    def distinct(self) -> tuple[FloatArray, FloatArray]:
        """Rays (k, 3) of mutually nearest features by the ratio test, most distinct first."""
        if not len(self.first):
            return np.empty((0, 3)), np.empty((0, 3))
        starts = np.flatnonzero(np.diff(self.first.astype(np.intp), prepend=-1))
        top = np.maximum.reduceat(self.likeness, starts)
        of_row = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(self.first)))
        is_top = self.likeness == top[of_row]
        at = np.flatnonzero(is_top)
        place = np.empty((len(starts), 3), np.float32)
        place[of_row[at]] = self.other_rays[self.second[at]]
        away = np.abs(self.other_rays.astype(np.float32)[self.second] - place[of_row]).max(axis=1)
        rest = np.where(away < _ONE_PLACE_RAD, np.float32(_LEAST_LIKENESS), self.likeness)
        second = np.maximum.reduceat(rest, starts)
        nearest = np.zeros(len(self.other_rays), np.float32)
        np.maximum.at(nearest, self.second, self.likeness)
        found = np.flatnonzero(is_top & (self.likeness == nearest[self.second]))
        # The distance of unit vectors is sqrt(2 - 2 cosine).
        row = of_row[found]
        ratio = np.sqrt(np.maximum(1.0 - top[row], 0.0) / np.maximum(1.0 - second[row], 1e-9))
        order = np.argsort(ratio, kind='stable')
        found = found[order[: np.count_nonzero(ratio < _MAX_RATIO)]]
        return self.rays[self.first[found]], self.other_rays[self.second[found]]


# Likeness below which no match passes the ratio test of `LikePairs.distinct`, rounded down: all
# that compete are at least as alike as `_LEAST_LIKENESS`.
_LEAST_TOP = 1.0 - _MAX_RATIO**2 * (1.0 - _LEAST_LIKENESS) - 1e-5


def like_pairs(one: Features, other: Features) -> LikePairs:
    """Compare all features of two panoramas; those of the first that match none are left out."""
    small = np.min_scalar_type(max(len(one), len(other)))
    parts = [(np.empty(0, small), np.empty(0, small), np.empty(0, np.float32))]
    for start in range(0, len(one), _ROWS):
        likeness = one.descriptors[start : start + _ROWS] @ other.descriptors.T
        rows = np.flatnonzero(likeness.max(1, initial=0.0) > _LEAST_TOP)
        likeness = likeness[rows]
        row, second = np.nonzero(likeness > _LEAST_LIKENESS)
        first = (rows[row] + start).astype(small)
        parts.append((first, second.astype(small), likeness[row, second]))
    return LikePairs(one.rays, other.rays, *map(np.concatenate, zip(*parts, strict=True)))


def alike_along(
    one: int,
    other: int,
    states: FloatArray,
    alike: LikePairs,
    band_sigmas: float,
    in_range: bool = False,
) -> LikePairs:
    """Select the pairs of features of two views near their epipolar curves, and in range there."""
    way = (center(states[other]) - center(states[one])).astype(np.float32)
    w, v = (
        turned(states[k], rays).astype(np.float32)
        for k, rays in ((one, alike.rays), (other, alike.other_rays))
    )
    by_w, by_v = np.cross(v, way), np.cross(way, w)
    band = band_sigmas * DIRECTION_SIGMA_RAD
    length = float(np.hypot(way[0], way[1]))

    def near(which: IndexArray) -> IndexArray:
        """Pairs, of those given, that are near their curves and, if asked, in range."""
        i, j = alike.first[which], alike.second[which]
        off = np.einsum('nk,nk->n', by_v[i], v[j])
        variance = cross(w[i], by_w[j]) ** 2 + cross(v[j], by_v[i]) ** 2
        variance += by_w[j, 2] ** 2 + by_v[i, 2] ** 2
        inside = off**2 < band**2 * variance
        which, i, j = which[inside], i[inside], j[inside]
        if not in_range:
            return np.asarray(which)
        parallax, inside = cross(w[i], v[j]), np.ones(len(i), bool)
        with np.errstate(divide='ignore', invalid='ignore'):
            for ahead in (cross(way, v)[j], cross(way, w)[i]):
                distance = ahead / parallax
                inside &= (distance > _NEAREST * length) & (distance < _FARTHEST * length)
        return np.asarray(which[inside])

    # Only features with a possible match there need to be compared with all that compete.
    possible = np.zeros(len(w), bool)
    possible[alike.first[near(np.flatnonzero(alike.likeness > _LEAST_TOP))]] = True
    return alike.chosen(near(np.flatnonzero(possible[alike.first])))


def matches_along(
    one: int,
    other: int,
    states: FloatArray,
    alike: LikePairs,
    band_sigmas: float = BAND,
) -> RayPairs:
    """Match the features of two views, those that are alike, near their epipolar curves."""
    near = alike_along(one, other, states, alike, band_sigmas, in_range=True)
    return RayPairs(one, other, *near.distinct())
