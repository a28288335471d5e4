"""Where to look: features, conspicuity, saliency, hierarchical selection."""

from __future__ import annotations

from landmark_nav.learning.attention.attend import (
    attend,
    Attention,
    select_candidates,
)
from landmark_nav.learning.attention.config import AttentionConfig, FEATURES
from landmark_nav.learning.attention.maps import attention_maps, AttentionMaps, saliency_map

__all__ = [
    'FEATURES',
    'Attention',
    'AttentionConfig',
    'AttentionMaps',
    'attend',
    'attention_maps',
    'saliency_map',
    'select_candidates',
]
