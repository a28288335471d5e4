"""Parameters of the adjustment, and of how its walls are judged."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter

__all__ = ['AdjustmentConfig', 'WallFitConfig']


@dataclass(frozen=True)
class AdjustmentConfig(Config):
    """What is expected before there are measurements, which refine it."""

    azimuth_sigma_rad: float = parameter(
        1.5e-4, 'what a panorama adds to each azimuth', minimum=0, maximum=0.1
    )
    tangent_sigma: float = parameter(
        1e-3, 'what a panorama adds to each tangent of elevation', minimum=0, maximum=0.1
    )
    relief_sigma_m: float = parameter(
        0.015,
        'how differently far from the wall things on one stretch of it hang',
        minimum=1e-4,
        maximum=1,
    )
    hanging_sigma_m: float = parameter(
        0.015, 'how differently far from the wall stretches of it hang', minimum=1e-4, maximum=1
    )
    hanging_length_m: float = parameter(
        0.6,
        'how long a stretch of wall hangs together, as an image does',
        minimum=0.05,
        maximum=10,
    )
    common_hanging_sigma_m: float = parameter(
        0.015, 'how far from the wall things hang on average', minimum=1e-4, maximum=1
    )
    wall_sigma_m: float = parameter(
        0.005, 'how far a wall lies from where the room says', minimum=1e-4, maximum=1
    )
    camera_weight: float = parameter(
        1.0,
        'how many measurements the expected sigmas of panoramas and of relief count for',
        minimum=1e-3,
        maximum=1e9,
    )
    place_weight: float = parameter(
        10.0,
        'how many measurements the expected sigmas of their places count for',
        minimum=1e-3,
        maximum=1e9,
    )
    room_weight: float = parameter(
        0.05,
        'how many measurements the expected sigmas of walls and hanging count for',
        minimum=1e-3,
        maximum=1e9,
    )


@dataclass(frozen=True)
class WallFitConfig(Config):
    """When a wall of the map is called wrong."""

    max_before_m: float = parameter(
        0.045, 'farthest that things hang before a wall, median, metres', minimum=0, maximum=1
    )
    max_behind_m: float = parameter(
        0.02, 'farthest that they seem to hang behind it, median, metres', minimum=0, maximum=1
    )
    max_turn_rad: float = parameter(
        0.03, 'greatest angle between patches and their wall', minimum=0, maximum=1
    )
