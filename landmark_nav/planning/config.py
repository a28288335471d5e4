"""What the planner knows of camera and room beyond the wall map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from landmark_nav.learning.adjustment import AdjustmentConfig
from landmark_nav.learning.election import ElectionConfig
from landmark_nav.learning.reference_area import ReferenceAreaConfig
from landmark_nav.learning.stereo import StereoConfig
from landmark_nav.localization.triplet.visibility import TripletConfig
from landmark_nav.parameters import check_order, Config, parameter

__all__ = ['PlanConfig']


@dataclass(frozen=True)
class PlanConfig(Config):
    """
    Camera, texture to be expected, and how finely the room is looked at.

    The bounds of the stages that will learn and localize are taken from their own parameters.
    """

    focal_px: float = parameter(
        555.0, 'focal length of the camera, pixels', minimum=50, maximum=20000
    )
    width_px: int = parameter(512, 'width of its images, pixels', minimum=16, maximum=16384)
    height_px: int = parameter(512, 'height of its images, pixels', minimum=16, maximum=16384)
    pan_min_rad: float = parameter(
        -np.pi, 'least pan of the joint, rad', minimum=-6.2832, maximum=6.2832
    )
    pan_max_rad: float = parameter(
        np.pi, 'largest pan of the joint, rad', minimum=-6.2832, maximum=6.2832
    )
    clearance_m: float = parameter(
        0.4, 'least distance of the robot from walls', minimum=0.05, maximum=5
    )
    spacing_m: float = parameter(
        0.25, 'grid of places and of wall samples, at the finest', minimum=0.05, maximum=5
    )
    candidates: int = parameter(
        120, 'patches that attention proposes in a panorama', minimum=3, maximum=5000
    )
    texture_low_m: float = parameter(
        0.8, 'height from which on walls are taken as textured', minimum=0, maximum=10
    )
    texture_high_m: float = parameter(
        2.0, 'height up to which walls are taken as textured', minimum=0.1, maximum=20
    )
    random_sets: int = parameter(
        50, 'sets of random places to compare with', minimum=1, maximum=10000
    )
    reference_area: ReferenceAreaConfig = field(default_factory=ReferenceAreaConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    election: ElectionConfig = field(default_factory=ElectionConfig)
    triplet: TripletConfig = field(default_factory=TripletConfig)

    def __post_init__(self) -> None:
        """Check the ranges."""
        super().__post_init__()
        check_order(self, 'pan_min_rad', 'pan_max_rad')

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
