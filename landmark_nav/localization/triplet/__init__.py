"""Where to look: the three landmarks that promise most."""

from __future__ import annotations

from landmark_nav.localization.triplet.selection import (
    Gaze,
    rank_triplets,
    TripletConfig,
    visible_landmarks,
)

__all__ = ['Gaze', 'TripletConfig', 'rank_triplets', 'visible_landmarks']
