"""
Cylindrical panorama: column <-> azimuth, row <-> tangent of the elevation.

This is the only place where "image right is clockwise" turns into counter-clockwise azimuths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import FloatArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_rad

# Largest tangent of elevation (60 degrees): the cylinder does not reach the poles, and walls seen
# more steeply are too oblique to be recognised.
STEEPEST_TANGENT = math.sqrt(3.0)
# Largest number of pixels; a sweep takes more than ten bytes for each.
_MAX_PIXELS = 16_000_000


@dataclass(frozen=True)
class Cylinder:
    """
    Geometry of a full-turn cylindrical image.

    Parameters
    ----------
    width, height : int
        Size, pixels; `width` spans exactly one turn.
    fy : float
        Pixels per unit tangent of elevation.
    cx : float
        Column of azimuth 0 in the base frame.
    cy : float
        Row of the horizon.
    """

    width: int
    height: int
    fy: float
    cx: float
    cy: float

    @classmethod
    def with_resolution(cls, px_per_rad: float, tan_min: float, tan_max: float) -> Cylinder:
        """
        Square-pixel cylinder of about `px_per_rad` that covers a range of tangents of elevation.

        Raises `LandmarkNavError`: it would have too many pixels.
        """
        ends = np.clip([tan_min, tan_max], -STEEPEST_TANGENT, STEEPEST_TANGENT)
        if not 0.0 <= 2.0 * np.pi * px_per_rad * px_per_rad * np.ptp(ends) <= _MAX_PIXELS:
            raise LandmarkNavError(
                f'a panorama of {px_per_rad:.0f} px/rad that covers tangents of elevation of '
                f'{ends[0]:.2f} to {ends[1]:.2f} has over {_MAX_PIXELS / 1e6:.0f} million pixels: '
                'lower px_per_rad'
            )
        width = round(2.0 * np.pi * px_per_rad)
        scale = width / (2.0 * np.pi)
        top = int(np.ceil(ends[1] * scale))
        bottom = int(np.ceil(-ends[0] * scale))
        return cls(width, top + bottom + 1, scale, (width - 1) / 2.0, float(top))

    @property
    def fx(self) -> float:
        """Pixels per radian of azimuth."""
        return self.width / (2.0 * np.pi)

    def wrap_column(self, column: npt.ArrayLike) -> FloatArray:
        """Columns wrapped to [-0.5, width - 0.5)."""
        column = np.asarray(column, dtype=np.float64)
        return np.asarray(np.mod(column + 0.5, self.width) - 0.5)

    def column_of(self, azimuth_rad: npt.ArrayLike) -> FloatArray:
        """Column of azimuths in the base frame, wrapped."""
        return self.wrap_column(self.cx - self.fx * np.asarray(azimuth_rad, dtype=np.float64))

    def azimuth_rad(self, column: npt.ArrayLike) -> FloatArray:
        """Azimuth of columns in the base frame, not wrapped."""
        return np.asarray((self.cx - np.asarray(column, dtype=np.float64)) / self.fx)

    def tangent(self, row: npt.ArrayLike) -> FloatArray:
        """Tangent of elevation of rows."""
        return np.asarray((self.cy - np.asarray(row, dtype=np.float64)) / self.fy)

    def row_of(self, tangent: npt.ArrayLike) -> FloatArray:
        """Row of tangents of elevation."""
        return np.asarray(self.cy - self.fy * np.asarray(tangent, dtype=np.float64))

    def rays(self, pixels: npt.ArrayLike) -> FloatArray:
        """Rays (..., 3) = (cos az, sin az, tan el) in the base frame, of (column, row) pixels."""
        pixels = np.asarray(pixels, dtype=np.float64)
        azimuth = self.azimuth_rad(pixels[..., 0])
        return np.stack([np.cos(azimuth), np.sin(azimuth), self.tangent(pixels[..., 1])], -1)

    def project(self, directions_base: npt.ArrayLike) -> FloatArray:
        """Pixels (column, row), (..., 2), of directions (..., 3) in the base frame."""
        d = np.asarray(directions_base, dtype=np.float64)
        column = self.column_of(np.arctan2(d[..., 1], d[..., 0]))
        with np.errstate(divide='ignore', invalid='ignore'):
            row = self.row_of(d[..., 2] / np.hypot(d[..., 0], d[..., 1]))
        return np.stack([column, row], -1)


# Largest number of angles in a message.
_MAX_LISTED = 4


def _first_few(words: Sequence[str], between: str) -> str:
    """Join the first words, and append how many more there are."""
    more = len(words) - _MAX_LISTED
    return between.join(words[:_MAX_LISTED]) + (f' and {more} more' if more > 0 else '')


def unseen_arcs(pan_rad: npt.ArrayLike, half_fov_rad: float) -> list[tuple[float, float]]:
    """
    Arcs (from, to), counter-clockwise, radians, that no frame covers.

    Parameters
    ----------
    pan_rad : array_like, shape (n,)
        Pans of the frames, in any order, not necessarily wrapped.
    half_fov_rad : float
        Half the horizontal field of view.
    """
    pan = np.unique(np.mod(np.asarray(pan_rad, dtype=np.float64), 2.0 * np.pi))
    if not len(pan):
        return [(-np.pi, np.pi)]
    steps = np.diff(pan, append=pan[0] + 2.0 * np.pi)
    width = steps - 2.0 * half_fov_rad
    starts = wrap_rad(pan + half_fov_rad)
    return [(float(starts[k]), float(starts[k] + width[k])) for k in np.flatnonzero(width > 0.0)]


def describe_coverage(
    pan_rad: npt.ArrayLike, half_fov_rad: float, missing_rad: npt.ArrayLike = ()
) -> str:
    """
    Message about the gaps of a sweep; empty if no frame is missing and the turn is complete.

    Parameters
    ----------
    pan_rad : array_like, shape (n,)
        Pans of the frames.
    half_fov_rad : float
        Half the horizontal field of view.
    missing_rad : array_like, shape (m,)
        Pans of the missing frames.
    """
    missing = [f'{np.degrees(pan):.0f}' for pan in np.asarray(missing_rad, dtype=np.float64)]
    arcs = [
        f'from pan {np.degrees(a):.0f} to {np.degrees(b):.0f} deg'
        for a, b in unseen_arcs(pan_rad, half_fov_rad)
    ]
    words = []
    if missing:
        listed = _first_few(missing, ', ')
        frames = '1 frame is' if len(missing) == 1 else f'{len(missing)} frames are'
        words.append(f'{frames} missing, at pan {listed} deg')
    if arcs:
        words.append(f'nothing is seen {_first_few(arcs, " and ")}')
    elif missing:
        words.append('their neighbours see it all')
    return '; '.join(words)
