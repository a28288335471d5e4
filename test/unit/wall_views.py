"""Grey images of rendered panoramas, and candidates where points are seen."""

from __future__ import annotations

import numpy as np

from landmark_nav.geometry import se2
from landmark_nav.types import Candidate, FloatArray, Panorama

__all__ = ['candidate_at']


def candidate_at(panorama: Panorama, point: FloatArray, size: int = 32) -> Candidate:
    """Candidate at the pixel nearest to where a panorama shows a point."""
    turned = (point - panorama.center_map)[:2] @ se2.rotation(panorama.heading_rad)
    column, row = panorama.cylinder.project([*turned, point[2] - panorama.center_map[2]])
    return Candidate(float(np.rint(column)), float(np.rint(row)), size, size, 1.0)
