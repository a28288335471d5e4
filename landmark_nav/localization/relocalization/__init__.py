"""Global localization: the pose without a prior."""

from __future__ import annotations

from landmark_nav.localization.relocalization.search import RelocalizationConfig
from landmark_nav.localization.relocalization.stream import Relocalizer, Unseen

__all__ = ['RelocalizationConfig', 'Relocalizer', 'Unseen']
