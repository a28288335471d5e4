"""
Template matching: normalized cross-correlation, then sub-pixel alignment.

Template and search image must have the same geometry: the learner matches wall textures, the
localizer matches camera images.
"""

from __future__ import annotations

from landmark_nav.matching.alignment import (
    blur_by,
    blur_sigmas,
    blur_to,
    Match,
    match_template,
    sigmas_of,
)

__all__ = ['Match', 'blur_by', 'blur_sigmas', 'blur_to', 'match_template', 'sigmas_of']
