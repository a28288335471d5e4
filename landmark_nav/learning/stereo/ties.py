"""Tie points: matched features, which give ranges and constrain the adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.learning.stereo.wall_patch import PatchMeasurement
from landmark_nav.types import FloatArray


@dataclass(frozen=True, eq=False)
class Ties:
    """Points (n, 3) in map, and the measurements of each in two panoramas."""

    positions: FloatArray
    measurements: list[list[PatchMeasurement]]

    def seen_by(self, panorama: int) -> FloatArray:
        """Points (m, 3) that a panorama shows."""
        shown = [panorama in {s.panorama for s in group} for group in self.measurements]
        return np.asarray(self.positions[np.array(shown, dtype=bool)])

    def pixels(self, panorama: int, cylinder: Cylinder) -> FloatArray:
        """Pixels (m, 2) of the points that a panorama shows."""
        shown = [s for group in self.measurements for s in group if s.panorama == panorama]
        azimuth, tangent = np.array([(s.azimuth_rad, s.tangent) for s in shown]).reshape(-1, 2).T
        return np.stack(
            [cylinder.column_of(azimuth) % cylinder.width, cylinder.row_of(tangent)], 1
        )
