"""Landmarks, panoramas and walls, refined together."""

from __future__ import annotations

from landmark_nav.learning.adjustment.solution import (
    adjust,
    Adjustment,
    AdjustmentConfig,
)

__all__ = ['Adjustment', 'AdjustmentConfig', 'adjust']
