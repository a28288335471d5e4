"""Parameters of the adjustment and of the check of walls."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config


@dataclass(frozen=True)
class AdjustmentConfig(Config):
    """
    Expected sigmas, which the residuals refine.

    docs/decisions.md (stereo, adjustment, election) compares lengths of wall sections and robust
    weights; the other values are chosen by hand.
    """

    # Sigma that a panorama adds to each azimuth.
    azimuth_sigma_rad: float = 1.5e-4
    # Sigma that a panorama adds to each tangent of elevation.
    tangent_sigma: float = 1e-3
    # Sigma that two panoramas add to the log ratio of their distances by depth from scale.
    nearness_sigma: float = 1.5e-3
    # Sigma of the tilt of each sweep's pan axis; 0 does not estimate it.
    tilt_sigma_rad: float = 0.0
    # Sigma of errors that azimuths of one panorama share, in waves of a quarter turn and longer; 0
    # does not estimate them.
    wave_sigma_rad: float = 0.0
    # Sigma of the distance from the wall within one section of it.
    relief_sigma_m: float = 0.015
    # Sigma of the distance from the wall between sections.
    hanging_sigma_m: float = 0.015
    # Length of a section of wall, within which errors are correlated, as in a picture.
    hanging_length_m: float = 0.6
    # Sigma of the mean distance of objects from all walls.
    common_hanging_sigma_m: float = 0.015
    # Sigma of the position of a wall in the plan.
    wall_sigma_m: float = 0.005
    # Weight of the expected sigmas of panoramas and of relief, in measurements.
    camera_weight: float = 1.0
    # Weight of the expected sigmas of their poses, in measurements.
    place_weight: float = 10.0
    # Weight of the expected sigmas of walls and of distances from them, in measurements.
    room_weight: float = 0.05


@dataclass(frozen=True)
class WallFitConfig(Config):
    """When a wall of the plan counts as wrong."""

    # Greatest median distance of patches in front of a wall, m.
    max_before_m: float = 0.045
    # Greatest median distance of patches behind a wall, m.
    max_behind_m: float = 0.02
    # Greatest angle between patches and their wall.
    max_turn_rad: float = 0.03
