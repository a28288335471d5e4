"""Parameters that all stages of detection share."""

from __future__ import annotations

from dataclasses import dataclass, field

from landmark_nav.localization.detection.expectation import DetectionConfig
from landmark_nav.localization.triangulation.robust import TriangulationConfig
from landmark_nav.localization.triplet.visibility import TripletConfig
from landmark_nav.parameters import Config


@dataclass(frozen=True)
class ImageStagesConfig(Config):
    """Parameters of triplet choice, detection and triangulation."""

    triplet: TripletConfig = field(default_factory=TripletConfig)
    detection: DetectionConfig = field(default_factory=DetectionConfig)
    triangulation: TriangulationConfig = field(default_factory=TriangulationConfig)
