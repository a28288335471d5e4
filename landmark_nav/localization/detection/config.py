"""Parameters of detection."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.localization.detection.appearance import APPEARANCES
from landmark_nav.parameters import Config, parameter

__all__ = ['DetectionConfig']


@dataclass(frozen=True)
class DetectionConfig(Config):
    """How landmarks are searched and what counts as found."""

    min_size_px: int = parameter(
        14, 'least width and height of a template, pixels', minimum=6, maximum=256
    )
    max_count: int = parameter(
        16,
        'most landmarks looked for in an image: the most informative ones',
        minimum=3,
        maximum=1000,
    )
    target_count: int = parameter(
        8,
        'landmarks looked for while most of those in the image before were found: more of them '
        'repeat what the map has wrong',
        minimum=3,
        maximum=1000,
        formerly='enough',
    )
    max_second_ratio: float = parameter(
        0.9, 'greatest share of the peak that another place may reach', minimum=0, maximum=1
    )
    window_sigmas: float = parameter(
        3.0, 'half width of the search in predicted standard deviations', minimum=1, maximum=6
    )
    max_window_px: int = parameter(
        80, 'largest half width of the search, pixels', minimum=4, maximum=2000
    )
    vertical_sigma_px: float = parameter(
        1.0, 'vertical error of the image from tilt and floor', minimum=0.1, maximum=50
    )
    appearance: str = parameter(
        'virtual_view',
        'what is looked for: the patch as it was learned, or a view from here out of all '
        'panoramas that saw it',
        choices=APPEARANCES,
    )
    lens_sigma_px: float = parameter(
        0.03, 'what the lens model leaves, pixels', minimum=0, maximum=5
    )
