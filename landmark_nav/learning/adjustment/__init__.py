"""Bundle adjustment of landmarks, panoramas and walls."""

from __future__ import annotations

from landmark_nav.learning.adjustment.depth_from_scale import depth_from_scale
from landmark_nav.learning.adjustment.problem import AdjustmentConfig, CALIBRATED
from landmark_nav.learning.adjustment.solution import adjust, Adjustment

__all__ = [
    'CALIBRATED',
    'Adjustment',
    'AdjustmentConfig',
    'adjust',
    'depth_from_scale',
]
