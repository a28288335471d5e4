"""Parameters of stereo."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter


@dataclass(frozen=True)
class StereoConfig(Config):
    """
    What counts as the same patch seen from two places.

    With `max_displaced_px` none of 1,343 landmarks was false in rooms 31 to 36 and 45 to 49, 6 of
    1,346 without. Resolution, blur: docs/decisions.md. The others are chosen by hand.
    """

    # Least normalized cross-correlation between two views.
    min_score: float = 0.75
    # Greatest share of the peak that another place may reach.
    max_second_ratio: float = 0.9
    # Greatest angle between a view and the normal.
    max_incidence_rad: float = 1.15
    # Least angle between two views of a landmark.
    min_parallax_rad: float = 0.04
    # How many times nearer one of two views in line must be, for depth from scale.
    min_approach: float = 1.25
    # How far behind the wall a match is searched.
    behind_wall_m: float = 0.15
    # How far before the wall a match is searched.
    before_wall_m: float = 0.5
    max_displaced_px: float = parameter(
        0.7,
        'how far a quarter of a patch may seem out of place between two views, pixels',
        minimum=0.05,
        maximum=100,
    )
    # How far off its wall a patch may hang, m; farther off it is on a plane of its own.
    max_off_wall_m: float = 0.06
    # The same of a patch that does not hang on a wall, whose location is then less certain, px.
    max_relief_px: float = 2.0
    # Search around the epipolar line, at least: more where places are uncertain.
    margin_m: float = 0.04
