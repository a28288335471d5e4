"""A pose from bearings."""

from __future__ import annotations

from landmark_nav.localization.triangulation.model import triangulate_three
from landmark_nav.localization.triangulation.robust import Fix, triangulate, TriangulationConfig

__all__ = ['Fix', 'TriangulationConfig', 'triangulate', 'triangulate_three']
