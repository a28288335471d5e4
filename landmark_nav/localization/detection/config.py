"""Parameters of detection."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config


@dataclass(frozen=True)
class DetectionConfig(Config):
    """
    How landmarks are searched and what counts as found.

    `target_count` and `appearance` were compared (docs/decisions.md, detection); the others are
    chosen by hand.
    """

    # Least width and height of a template, pixels.
    min_size_px: int = 14
    # Most landmarks looked for in an image: the most informative ones.
    max_count: int = 16
    # Landmarks looked for while most of those in the image before were found: more of them repeat
    # what the map has wrong.
    target_count: int = 8
    # Greatest share of the peak that another place may reach.
    max_second_ratio: float = 0.9
    # Half width of the search in predicted standard deviations.
    window_sigmas: float = 3.0
    # Largest half width of the search, pixels.
    max_window_px: int = 80
    # Vertical error of the image from tilt and floor.
    vertical_sigma_px: float = 1.0
    # What is looked for: the patch as it was learned, or a view from here out of all panoramas
    # that saw it.
    appearance: str = 'virtual_view'
    # What the lens model leaves, pixels.
    lens_sigma_px: float = 0.03
