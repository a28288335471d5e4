"""Parameters of stereo."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter


@dataclass(frozen=True)
class StereoConfig(Config):
    """
    When two views show the same patch.

    With `max_displaced_px` none of 1,343 landmarks was false in rooms 31 to 36 and 45 to 49;
    without it 6 of 1,346 were. docs/decisions.md compares resolutions and blur. The other values
    are chosen by hand.
    """

    # Least normalized cross-correlation between two views.
    min_score: float = 0.75
    # Greatest score of a second peak, relative to the best.
    max_second_ratio: float = 0.9
    # Greatest angle between a view and the normal.
    max_incidence_rad: float = 1.15
    # Least angle between two views of a landmark.
    min_parallax_rad: float = 0.04
    # Least ratio of ranges of two views in line, for depth from scale.
    min_approach: float = 1.25
    # Range of the search behind the wall.
    behind_wall_m: float = 0.15
    # Range of the search in front of the wall.
    before_wall_m: float = 0.5
    max_displaced_px: float = parameter(
        0.7,
        'greatest displacement of a quarter of a patch between two views, pixels',
        minimum=0.05,
        maximum=100,
    )
    # Greatest distance of a patch from its wall, m; farther off it is on a plane of its own.
    max_off_wall_m: float = 0.06
    # Greatest displacement of a quarter of a patch that is not on a wall, px: its location is less
    # certain then.
    max_relief_px: float = 2.0
    # Least half width of the search about the epipolar line; uncertain poses widen it.
    margin_m: float = 0.04
