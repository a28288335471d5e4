"""Parameters that whatever looks for landmarks has in common."""

from __future__ import annotations

from dataclasses import dataclass, field

from landmark_nav.localization.detection import DetectionConfig
from landmark_nav.localization.triangulation import TriangulationConfig
from landmark_nav.localization.triplet.visibility import TripletConfig
from landmark_nav.parameters import Config


@dataclass(frozen=True)
class LookingConfig(Config):
    """What should be in view, how it is found there, and how a place follows from it."""

    triplet: TripletConfig = field(default_factory=TripletConfig)
    detection: DetectionConfig = field(default_factory=DetectionConfig)
    triangulation: TriangulationConfig = field(default_factory=TriangulationConfig)
