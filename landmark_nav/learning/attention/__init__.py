"""Attention: features, conspicuity, saliency, hierarchical selection of candidates."""

from __future__ import annotations

from landmark_nav.learning.attention.attend import attend, Attention
from landmark_nav.learning.attention.maps import (
    attention_maps,
    AttentionConfig,
    AttentionMaps,
    FEATURES,
)

__all__ = [
    'FEATURES',
    'Attention',
    'AttentionConfig',
    'AttentionMaps',
    'attend',
    'attention_maps',
]
