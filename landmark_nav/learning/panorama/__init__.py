"""Frames of a sweep become one cylindrical panorama."""

from __future__ import annotations

from landmark_nav.learning.panorama.synthesis import (
    BLENDS,
    CylinderImage,
    PanoramaConfig,
    synthesize_cylinder,
)

__all__ = ['BLENDS', 'CylinderImage', 'PanoramaConfig', 'synthesize_cylinder']
