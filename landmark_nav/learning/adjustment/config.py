"""Parameters of the adjustment, and of how its walls are judged."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config


@dataclass(frozen=True)
class AdjustmentConfig(Config):
    """
    What is expected before there are measurements, which refine it.

    Stretches of wall and robust weights were compared (docs/decisions.md, stereo, adjustment,
    election); the others are chosen by hand, and residuals refine them.
    """

    # What a panorama adds to each azimuth.
    azimuth_sigma_rad: float = 1.5e-4
    # What a panorama adds to each tangent of elevation.
    tangent_sigma: float = 1e-3
    # What two panoramas add to the ratio of their distances that sizes give.
    nearness_sigma: float = 1.5e-3
    # How far the pan axis of each sweep leans otherwise than known; 0 does not estimate it.
    tilt_sigma_rad: float = 0.0
    # How far azimuths of one panorama err in common, in waves of a quarter turn and longer; 0 does
    # not estimate it.
    wave_sigma_rad: float = 0.0
    # How differently far from the wall things on one stretch of it hang.
    relief_sigma_m: float = 0.015
    # How differently far from the wall stretches of it hang.
    hanging_sigma_m: float = 0.015
    # How long a stretch of wall hangs together, as an image does.
    hanging_length_m: float = 0.6
    # How far from the wall things hang on average.
    common_hanging_sigma_m: float = 0.015
    # How far a wall lies from where the room says.
    wall_sigma_m: float = 0.005
    # How many measurements the expected sigmas of panoramas and of relief count for.
    camera_weight: float = 1.0
    # How many measurements the expected sigmas of their places count for.
    place_weight: float = 10.0
    # How many measurements the expected sigmas of walls and hanging count for.
    room_weight: float = 0.05


@dataclass(frozen=True)
class WallFitConfig(Config):
    """When a wall of the map is called wrong."""

    # Farthest that things hang before a wall, median, metres.
    max_before_m: float = 0.045
    # Farthest that they seem to hang behind it, median, metres.
    max_behind_m: float = 0.02
    # Greatest angle between patches and their wall.
    max_turn_rad: float = 0.03
