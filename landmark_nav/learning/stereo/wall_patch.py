"""
Patches of walls and their texture in panoramas.

The ray of a candidate meets a wall. Resampling on the wall removes the effects of slant and
distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from landmark_nav.arrays import Float32Array, IndexArray
from landmark_nav.geometry.patches import patch_axes
from landmark_nav.parameters import Config, parameter
from landmark_nav.types import Candidate, FloatArray, Panorama


@dataclass(frozen=True)
class StereoConfig(Config):
    """
    When two views show the same patch.

    With `max_displaced_px` none of 1,343 landmarks was false in rooms 31 to 36 and 45 to 49;
    without it 6 of 1,346 were. docs/decisions.md compares resolutions and blur. The other values
    are chosen by hand.
    """

    # Least normalized cross-correlation between two views.
    min_score: float = 0.75
    # Greatest score of a second peak, relative to the best.
    max_second_ratio: float = 0.9
    # Greatest angle between a view and the normal.
    max_incidence_rad: float = 1.15
    # Least angle between two views of a landmark.
    min_parallax_rad: float = 0.04
    # Least ratio of ranges of two views in line, for depth from scale.
    min_approach: float = 1.25
    # Range of the search behind the wall and in front of it.
    behind_wall_m: float = 0.15
    before_wall_m: float = 0.5
    max_displaced_px: float = parameter(
        0.7,
        'greatest displacement of a quarter of a patch between two views, pixels',
        minimum=0.05,
        maximum=100,
    )
    # Greatest distance of a patch from its wall, m; farther off it is on a plane of its own.
    max_off_wall_m: float = 0.06
    # Greatest displacement of a quarter of a patch that is not on a wall, px: its location is less
    # certain then.
    max_relief_px: float = 2.0
    # Least half width of the search about the epipolar line; uncertain poses widen it.
    margin_m: float = 0.04


@dataclass(frozen=True, eq=False)
class WallPatch:
    """
    The patch of a candidate, on the wall behind it or on a plane of its own.

    `position` (3,) and `normal` (3,) are in map; `shape` (rows, columns) and `texel_m` are those
    of its texture; `source` is the panorama that proposed it; `wall` the one behind it, or -1.
    """

    candidate: Candidate
    source: int
    wall: int
    position: FloatArray
    normal: FloatArray
    shape: tuple[int, int]
    texel_m: float
    on_wall: bool = True

    @cached_property
    def axes(self) -> FloatArray:
        """Unit vectors (2, 3) to the right and down."""
        return np.stack(patch_axes(self.normal))

    def reach_m(self, panorama: Panorama) -> float:
        """Distance of a panorama from the plane of the patch."""
        return float((panorama.center_map - self.position) @ self.normal)


@dataclass(frozen=True, eq=False)
class PatchMeasurement:
    """
    Direction of a patch in a panorama: azimuth in its base frame, tangent, their sigmas.

    `log_nearer` is the depth from scale: the logarithm of the distance of the proposing panorama
    from the patch's plane over that of this panorama.
    """

    panorama: int
    azimuth_rad: float
    tangent: float
    sigma_azimuth_rad: float
    sigma_tangent: float
    score: float
    log_nearer: float = 0.0
    sigma_log_nearer: float = np.inf


@dataclass(frozen=True, eq=False)
class Ties:
    """
    Points (n, 3) in map, and the measurements of each in two panoramas.

    `shared_errors` (4 v, q) are errors that the poses x, y, z, heading of v panoramas share, as
    factors with unit variance.
    """

    positions: FloatArray
    measurements: list[list[PatchMeasurement]]
    shared_errors: FloatArray

    def seen_by(self, panorama: int) -> FloatArray:
        """Points (m, 3) that a panorama shows."""
        return np.asarray(self.positions[(self._views == panorama).any(axis=1)])

    @cached_property
    def _views(self) -> IndexArray:
        """Both panoramas (n, 2) of each point."""
        return np.array([[s.panorama for s in g] for g in self.measurements]).reshape(-1, 2)


def own_measurement(patch: WallPatch, panorama: Panorama) -> PatchMeasurement:
    """Measurement in the panorama that proposed the patch, which defines it."""
    azimuth = float(panorama.cylinder.azimuth_rad(patch.candidate.column))
    tangent = float(panorama.cylinder.tangent(patch.candidate.row))
    return PatchMeasurement(patch.source, azimuth, tangent, 0.0, 0.0, 1.0)


def wall_texture(patch: WallPatch, panorama: Panorama) -> Float32Array | None:
    """Texture of a patch in a panorama; None if that does not cover it."""
    columns, rows = _pixels(patch, panorama)
    height, width = panorama.mask.shape
    if not (rows.min() >= 1.0 and rows.max() <= height - 2.0):
        return None
    corners = np.rint(rows[[0, -1]][:, [0, -1]]).astype(int)
    if not panorama.mask[corners, np.rint(columns[[0, -1]]).astype(int) % width].all():
        return None
    found = cv2.remap(
        panorama.grey,
        np.tile(columns.astype(np.float32), (patch.shape[0], 1)),
        rows.astype(np.float32),
        cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_WRAP,
    )
    return np.asarray(found, dtype=np.float32)


def covered_rows(patch: WallPatch, panorama: Panorama) -> slice:
    """Rows of a patch that a panorama covers, possibly none."""
    some = np.array([0, patch.shape[1] // 2, patch.shape[1] - 1])
    columns, rows = (np.rint(pixels).astype(int) for pixels in _pixels(patch, panorama, some))
    height, width = panorama.mask.shape
    seen = (rows >= 2) & (rows <= height - 3)
    covered = (seen & panorama.mask[np.clip(rows, 0, height - 1), columns % width]).all(1)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], covered, [False]]).astype(int)))
    if not len(ends):
        return slice(0, 0)
    runs = ends.reshape(-1, 2)
    first, last = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return slice(int(first), int(last))


def _pixels(
    patch: WallPatch, panorama: Panorama, some: IndexArray | slice = slice(None)
) -> tuple[FloatArray, FloatArray]:
    """Pixels of a patch's texels, or of `some` columns of it: columns (w,) and rows (h, w)."""
    # Patch and cylinder are upright: a column of the patch lies in one column of the panorama.
    cylinder = panorama.cylinder
    right, down = patch.axes
    offset = patch.position - panorama.center_map
    across, below = ((np.arange(n) - (n - 1) / 2.0) * patch.texel_m for n in patch.shape[::-1])
    ray = offset[:2] + across[some, None] * right[:2]
    azimuth = np.arctan2(ray[:, 1], ray[:, 0]) - panorama.heading_rad
    tangent = (offset[2] + below * down[2])[:, None] / np.hypot(ray[:, 0], ray[:, 1])
    return cylinder.column_of(azimuth), cylinder.row_of(tangent)


def shown_at(
    position: FloatArray, normal: FloatArray, panorama: Panorama, measured: PatchMeasurement
) -> FloatArray:
    """
    Point (3,) on the plane of a patch that a panorama shows in the measured direction.

    It is off the adjusted position by what the upright panorama leaves out, as its tilt. It is NaN
    if that direction or the panorama does not face the plane.
    """
    azimuth = panorama.heading_rad + measured.azimuth_rad
    ray = np.array([np.cos(azimuth), np.sin(azimuth), measured.tangent])
    depth, slope = (position - panorama.center_map) @ normal, ray @ normal
    reach = depth / slope if max(depth, slope) < 0.0 else np.nan
    return np.asarray(panorama.center_map + reach * ray)


def texels_per_pixel(patch: WallPatch, panorama: Panorama) -> FloatArray:
    """Texels per pixel of a panorama, across and down the patch."""
    ray = patch.position - panorama.center_map
    reach = float(np.hypot(ray[0], ray[1]))
    cosine = -float(ray[:2] @ patch.normal[:2]) / reach
    pixel = reach / panorama.cylinder.fy / patch.texel_m
    return np.array([pixel / max(cosine, 0.1), pixel])
