"""Parameters of detection."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config


@dataclass(frozen=True)
class DetectionConfig(Config):
    """
    How landmarks are searched and what counts as found.

    docs/decisions.md (detection) compares values of `target_count`; the others are chosen by
    hand.
    """

    # Least width and height of a template, pixels.
    min_size_px: int = 14
    # Most landmarks searched in an image: the most informative ones.
    max_count: int = 16
    # Landmarks searched in an image while most of those in the last image were found: with more,
    # the errors of the map dominate.
    target_count: int = 8
    # Greatest score of a second peak, relative to the best.
    max_second_ratio: float = 0.9
    # Half width of the search window, in predicted sigmas.
    window_sigmas: float = 3.0
    # Largest half width of the search window, pixels.
    max_window_px: int = 80
    # Vertical sigma of matches by tilt and floor, pixels.
    vertical_sigma_px: float = 1.0
    # Sigma of the residual error of the lens model, pixels.
    lens_sigma_px: float = 0.03
