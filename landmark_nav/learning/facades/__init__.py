"""Facades: flat vertical surfaces found in panoramas, and the room that they enclose."""

from __future__ import annotations

from landmark_nav.learning.facades.outline import open_room, room_of
from landmark_nav.learning.facades.planes import Facade, FacadesConfig, find_facades
from landmark_nav.learning.facades.points import placed_matches, SeenPoints

__all__ = [
    'Facade',
    'FacadesConfig',
    'SeenPoints',
    'find_facades',
    'open_room',
    'placed_matches',
    'room_of',
]
