"""Where to look: features, conspicuity, saliency, hierarchical selection."""

from __future__ import annotations

from landmark_nav.learning.attention.attend import (
    attend,
    Attention,
    saliency_map,
    select_candidates,
)
from landmark_nav.learning.attention.config import AttentionConfig, FEATURES

__all__ = [
    'FEATURES',
    'Attention',
    'AttentionConfig',
    'attend',
    'saliency_map',
    'select_candidates',
]
