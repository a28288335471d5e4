"""Where to look: the three landmarks that promise most."""

from __future__ import annotations

from landmark_nav.localization.triplet.selection import (
    Gaze,
    rank_triplets,
    select_triplet,
    TripletConfig,
    visible_landmarks,
)

__all__ = ['Gaze', 'TripletConfig', 'rank_triplets', 'select_triplet', 'visible_landmarks']
