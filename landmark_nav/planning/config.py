"""What the planner knows of camera and room beyond the wall map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from landmark_nav.learning.adjustment import AdjustmentConfig
from landmark_nav.learning.election import ElectionConfig
from landmark_nav.learning.reference_area import ReferenceAreaConfig
from landmark_nav.learning.stereo import StereoConfig
from landmark_nav.localization.triplet.visibility import TripletConfig
from landmark_nav.parameters import Config


@dataclass(frozen=True)
class PlanConfig(Config):
    """
    Camera, texture to be expected, and how finely the room is looked at.

    The bounds of the stages that will learn and localize are taken from their own parameters.
    """

    focal_px: float = 555.0
    width_px: int = 512
    height_px: int = 512
    pan_min_rad: float = -np.pi
    pan_max_rad: float = np.pi
    # Least distance of the robot from walls.
    clearance_m: float = 0.4
    # Grid of places and of wall samples, at the finest.
    spacing_m: float = 0.25
    # Patches that attention proposes in a panorama.
    candidates: int = 120
    # Heights between which walls are taken as textured.
    texture_low_m: float = 0.8
    texture_high_m: float = 2.0
    # Sets of random places to compare with.
    random_sets: int = 50
    reference_area: ReferenceAreaConfig = field(default_factory=ReferenceAreaConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    election: ElectionConfig = field(default_factory=ElectionConfig)
    triplet: TripletConfig = field(default_factory=TripletConfig)

    @property
    def steepest(self) -> float:
        """Greatest tangent of elevation that the panoramas show."""
        return (0.5 * self.height_px - self.triplet.border_px) / self.focal_px

    @property
    def half_arc_rad(self) -> float:
        """How far to both sides of the middle of its range the turning camera sees."""
        half_fov = float(np.arctan(0.5 * self.width_px / self.focal_px))
        return min(float(np.pi), 0.5 * (self.pan_max_rad - self.pan_min_rad) + half_fov)

    @property
    def paper_pans_rad(self) -> tuple[float, ...]:
        """Pans at which a sweep may have the papers ahead, tried in turn."""
        if self.half_arc_rad == np.pi:
            return (0.0,)
        middle = 0.5 * (self.pan_min_rad + self.pan_max_rad)
        quarter = 0.25 * (self.pan_max_rad - self.pan_min_rad)
        return (middle, middle - quarter, middle + quarter)
