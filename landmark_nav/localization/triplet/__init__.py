"""Where to look: the three landmarks with the best expected fix."""

from __future__ import annotations

from landmark_nav.localization.triplet.planning_scene import CameraState
from landmark_nav.localization.triplet.selection import rank_triplets
from landmark_nav.localization.triplet.visibility import TripletConfig, visible_landmarks

__all__ = ['CameraState', 'TripletConfig', 'rank_triplets', 'visible_landmarks']
