"""Parameters of stereo."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter

__all__ = ['StereoConfig']


@dataclass(frozen=True)
class StereoConfig(Config):
    """What counts as the same patch seen from two places."""

    min_score: float = parameter(
        0.75, 'least normalized cross-correlation between two views', minimum=0, maximum=1
    )
    max_incidence_rad: float = parameter(
        1.15, 'greatest angle between a view and the normal', minimum=0.1, maximum=1.5
    )
    min_parallax_rad: float = parameter(
        0.04, 'least angle between two views of a landmark', minimum=0, maximum=1.5
    )
    behind_wall_m: float = parameter(
        0.15, 'how far behind the wall a match is searched', minimum=0, maximum=2
    )
    before_wall_m: float = parameter(
        0.5, 'how far before the wall a match is searched', minimum=0, maximum=5
    )
    max_displaced_px: float = parameter(
        0.7,
        'how far a quarter of a patch may seem out of place between two views, pixels',
        minimum=0.05,
        maximum=100,
    )
    margin_m: float = parameter(
        0.04,
        'search around the epipolar line, at least: more where places are uncertain',
        minimum=0.005,
        maximum=0.5,
    )
