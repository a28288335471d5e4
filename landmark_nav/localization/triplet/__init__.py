"""Where to look: the three landmarks with the best expected fix."""

from __future__ import annotations

from landmark_nav.localization.triplet.selection import (
    CameraState,
    rank_triplets,
    TripletConfig,
    visible_landmarks,
)

__all__ = ['CameraState', 'TripletConfig', 'rank_triplets', 'visible_landmarks']
