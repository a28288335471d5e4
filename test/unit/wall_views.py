"""Grey images of rendered panoramas, and candidates where points are seen."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.geometry import se2
from landmark_nav.types import Candidate, FloatArray, Panorama

__all__ = ['candidate_at', 'greys_of']


def greys_of(panoramas: Sequence[Panorama]) -> list[npt.NDArray[np.float32]]:
    """Grey images."""
    return [cv2.cvtColor(p.image, cv2.COLOR_BGR2GRAY).astype(np.float32) for p in panoramas]


def candidate_at(panorama: Panorama, point: FloatArray, size: int = 32) -> Candidate:
    """Candidate at the pixel nearest to where a panorama shows a point."""
    turned = (point - panorama.center_map)[:2] @ se2.rotation(panorama.heading_rad)
    column, row = panorama.cylinder.project([*turned, point[2] - panorama.center_map[2]])
    return Candidate(float(np.rint(column)), float(np.rint(row)), size, size, 1.0)
