"""How landmarks may look in an image, and where: from anywhere, or from where a prior allows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from landmark_nav.geometry.se2 import rotation
from landmark_nav.localization.relocalization.strip import Strip
from landmark_nav.types import FloatArray, Landmark, LandmarkMap, PoseEstimate

__all__ = ['RANGE_SIGMA', 'SearchRange', 'any_range', 'unhidden_ranges']

# Ranges relative to the one a landmark was learned from, and how much narrower than straight
# ahead: neighbours differ by what normalized cross-correlation forgives.
_STEP = 1.4
_RELATIVE_RANGES = 0.55 * _STEP ** np.arange(5)
_FORESHORTENINGS = (0.9, 0.6)
# Half of a step between ranges.
RANGE_SIGMA = 0.15
# What is open is what so many sigmas of a prior reach.
_OPEN_SIGMAS = 2.5
# Patches seen narrower are not found.
_LEAST_FORESHORTENING = 0.3


class SearchRange(NamedTuple):
    """Ranges and narrowings a landmark may have, and the columns (first, end) it may be in."""

    ranges: FloatArray
    foreshortenings: FloatArray
    columns: tuple[int, int]


def any_range(landmark: Landmark, strip: Strip) -> SearchRange:
    """Look of a landmark from anywhere that it can be recognised from."""
    reference = float(np.hypot(*(landmark.position - landmark.viewpoint)[:2]))
    ranges = np.asarray(reference * _RELATIVE_RANGES, dtype=np.float64)
    return SearchRange(ranges, np.array(_FORESHORTENINGS), (0, len(strip.azimuth)))


def unhidden_ranges(
    prior: PoseEstimate, landmark_map: LandmarkMap, strip: Strip
) -> dict[int, SearchRange]:
    """Looks of the landmarks that may be in the image, as sigma points of the prior have it."""
    axes = _OPEN_SIGMAS * np.linalg.cholesky(prior.covariance).T
    poses = prior.pose + np.vstack([np.zeros(3), axes, -axes])
    turned = rotation(poses[:, 2])
    # From map into the base frame: rows times the rotation are turned back by it.
    place = (landmark_map.positions[:, :2] - poses[:, None, :2]) @ turned - strip.center[:2]
    reach = np.maximum(np.hypot(place[..., 0], place[..., 1]), 0.1)
    aside = strip.aside(np.arctan2(place[..., 1], place[..., 0]))
    normal = landmark_map.normals[:, :2] @ turned
    facing = -np.sum(place * normal, -1) / reach
    reference = np.hypot(*(landmark_map.positions - landmark_map.viewpoints)[:, :2].T)
    nearest, farthest = reach.min(axis=0), reach.max(axis=0)
    nearest = np.maximum(nearest, _RELATIVE_RANGES[0] * reference)
    farthest = np.minimum(farthest, _RELATIVE_RANGES[-1] * reference)
    least, most = np.maximum(facing.min(axis=0), _LEAST_FORESHORTENING), facing.max(axis=0)
    margin = 0.5 * landmark_map.sizes_m[:, 0] / reach.min(axis=0)
    columns = strip.columns(aside.max(axis=0) + margin, aside.min(axis=0) - margin)
    return {
        int(k): SearchRange(
            _steps(nearest[k], farthest[k]), _steps(least[k], most[k]), tuple(columns[:, k])
        )
        for k in np.flatnonzero(
            (farthest > nearest) & (most > _LEAST_FORESHORTENING) & (columns[1] > columns[0])
        )
    }


def _steps(low: float, high: float) -> FloatArray:
    """Values from low to high, apart by a step at most and half of that from the ends."""
    count = max(1, int(np.ceil(np.log(high / low) / np.log(_STEP))))
    return np.asarray(low * (high / low) ** ((np.arange(count) + 0.5) / count))
