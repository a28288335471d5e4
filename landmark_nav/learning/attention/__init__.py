"""Where to look: features, conspicuity, saliency, hierarchical selection."""

from __future__ import annotations

from landmark_nav.learning.attention.attend import attend, Attention
from landmark_nav.learning.attention.config import AttentionConfig, FEATURES
from landmark_nav.learning.attention.maps import attention_maps, AttentionMaps

__all__ = [
    'FEATURES',
    'Attention',
    'AttentionConfig',
    'AttentionMaps',
    'attend',
    'attention_maps',
]
