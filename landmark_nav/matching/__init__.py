"""
Template matching: normalized cross-correlation, then sub-pixel alignment.

Template and search image must have the same geometry: the learner matches wall textures, the
localizer matches camera images.
"""

from __future__ import annotations

from landmark_nav.matching.alignment import blur_by, blur_sigmas, blur_to, sigmas_of
from landmark_nav.matching.correlation import Match, match_template, match_templates, Query

__all__ = [
    'Match',
    'Query',
    'blur_by',
    'blur_sigmas',
    'blur_to',
    'match_template',
    'match_templates',
    'sigmas_of',
]
