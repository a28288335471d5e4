"""Matches along epipolar curves, once poses are known about: the most alike on the curve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from landmark_nav.learning.relative_pose.config import RelativePoseConfig
from landmark_nav.learning.relative_pose.epipolar import center, RayPairs, turned
from landmark_nav.learning.relative_pose.features import Features
from landmark_nav.types import FloatArray

# Half the width of the band about the curve, standard deviations: poses are not yet exact.
_BAND = 6.0
# Least cosine of two descriptors that may be one feature.
_LEAST_LIKENESS = 0.8
# Nearer than this share of the way between two panoramas, and farther than so many, is nothing.
_NEAREST, _FARTHEST = 0.15, 30.0


def matches_along(
    one: int,
    other: int,
    states: FloatArray,
    features: Sequence[Features],
    lever: FloatArray,
    config: RelativePoseConfig,
) -> RayPairs:
    """Match the features of two views near each other's epipolar curves."""
    here, there = center(states[one], lever), center(states[other], lever)
    way = there - here
    w, v = (turned(states[k], features[k].rays).astype(np.float32) for k in (one, other))
    way32 = way.astype(np.float32)
    by_w, by_v = np.cross(v, way32), np.cross(way32, w)
    off = by_v @ v.T
    across_w, across_v = (np.stack([-r[:, 1], r[:, 0], 0 * r[:, 0]], 1) for r in (w, v))
    variance = (across_w @ by_w.T) ** 2 + (by_v @ across_v.T) ** 2
    variance += by_w[:, 2] ** 2 + by_v[:, 2:] ** 2
    band = _BAND * config.direction_sigma_rad
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
    best = likeness.argmax(1)
    rows = np.arange(len(w))
    top = likeness[rows, best]
    mutual = likeness.argmax(0)[best] == rows
    likeness[rows, best] = -1.0
    second = np.maximum(likeness.max(1), 0.0)
    distinct = 1.0 - top < config.max_ratio**2 * (1.0 - second)
    kept = mutual & distinct & (top > _LEAST_LIKENESS)
    return RayPairs(one, other, features[one].rays[kept], features[other].rays[best[kept]])
