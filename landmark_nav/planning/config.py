"""Configuration of the planner."""

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
    Camera, expected texture, and sampling of the room.

    The bounds of learning and localization are those of their own parameters.
    """

    focal_px: float = 555.0
    width_px: int = 512
    height_px: int = 512
    pan_min_rad: float = -np.pi
    pan_max_rad: float = np.pi
    # Smallest distance of the robot from walls.
    clearance_m: float = 0.4
    # Smallest spacing of floor points and of wall samples.
    spacing_m: float = 0.25
    # Number of patches that attention proposes in a panorama.
    candidates: int = 120
    # Heights between which walls are assumed to be textured.
    texture_low_m: float = 0.8
    texture_high_m: float = 2.0
    # Number of random sets of positions for comparison.
    random_sets: int = 50
    reference_area: ReferenceAreaConfig = field(default_factory=ReferenceAreaConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    election: ElectionConfig = field(default_factory=ElectionConfig)
    triplet: TripletConfig = field(default_factory=TripletConfig)

    @property
    def steepest(self) -> float:
        """Largest tangent of elevation in panoramas."""
        return (0.5 * self.height_px - self.triplet.border_px) / self.focal_px

    @property
    def half_arc_rad(self) -> float:
        """Largest azimuth that the camera sees to either side of the middle of its pan range."""
        half_fov = float(np.arctan(0.5 * self.width_px / self.focal_px))
        return min(float(np.pi), 0.5 * (self.pan_max_rad - self.pan_min_rad) + half_fov)

    @property
    def paper_pans_rad(self) -> tuple[float, ...]:
        """Pans toward the papers that are tried for a sweep."""
        if self.half_arc_rad == np.pi:
            return (0.0,)
        middle = 0.5 * (self.pan_min_rad + self.pan_max_rad)
        quarter = 0.25 * (self.pan_max_rad - self.pan_min_rad)
        return (middle, middle - quarter, middle + quarter)
