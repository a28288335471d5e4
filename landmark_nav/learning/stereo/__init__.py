"""Stereo: patches of one panorama matched in others."""

from __future__ import annotations

from landmark_nav.learning.stereo.wall_patch import StereoConfig
from landmark_nav.learning.stereo.wall_stereo import compare, hypothesize, match_in

__all__ = ['StereoConfig', 'compare', 'hypothesize', 'match_in']
