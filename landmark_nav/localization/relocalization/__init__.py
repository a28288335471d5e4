"""The place from nothing."""

from __future__ import annotations

from landmark_nav.localization.relocalization.search import (
    locate,
    RelocalizationConfig,
    relocalize,
    shows_new,
    view_direction,
)

__all__ = ['RelocalizationConfig', 'locate', 'relocalize', 'shows_new', 'view_direction']
