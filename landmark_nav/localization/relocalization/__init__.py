"""The place from nothing."""

from __future__ import annotations

from landmark_nav.localization.relocalization.config import RelocalizationConfig
from landmark_nav.localization.relocalization.stream import Relocalizer, Unseen

__all__ = ['RelocalizationConfig', 'Relocalizer', 'Unseen']
