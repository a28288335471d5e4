"""Synthesis of a cylindrical panorama from the frames of a sweep."""

from __future__ import annotations

from landmark_nav.learning.panorama.synthesis import (
    BLENDS,
    CylinderImage,
    PanoramaConfig,
    synthesize_cylinder,
)

__all__ = ['BLENDS', 'CylinderImage', 'PanoramaConfig', 'synthesize_cylinder']
