"""Parameters of attention."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from landmark_nav.errors import LandmarkNavError
from landmark_nav.parameters import Config, parameter

FEATURES = (
    'intensity',
    'edges',
    'vertical_edges',
    'corners',
    'symmetry',
    'radial_symmetry',
    'line_symmetry',
)


@dataclass(frozen=True)
class AttentionConfig(Config):
    """
    What attracts attention, what size is cut out, and what is refused.

    The weights are in proportion to what each feature proposes, alone, that is found again more
    often than chance, in simulated rooms kept for tuning (docs/decisions.md).

    """

    # Weight of bright areas.
    weight_intensity: float = 0.0
    # Weight of Canny edges.
    weight_edges: float = 0.25
    # Weight of vertical edges, which fix a bearing.
    weight_vertical_edges: float = 0.0
    # Weight of corners.
    weight_corners: float = 0.2
    # Weight of symmetry about a point.
    weight_symmetry: float = 0.25
    # Weight of symmetry about a point that edges vote for.
    weight_radial_symmetry: float = 0.2
    # Weight of symmetry about vertical lines.
    weight_line_symmetry: float = 0.1
    # Least width and height of a patch, px.
    size_min_px: int = 28
    # Largest width and height of a patch, px.
    size_max_px: int = 32
    # Step between sizes, px.
    size_step_px: int = 2
    candidates: int = parameter(120, 'patches per panorama at most', minimum=1, maximum=10000)
    # Stop where the response falls below this share of the first.
    least_response: float = 0.1
    # Patches per sector at most.
    candidates_per_sector: int = 12
    # How far to either side a patch may be mistaken.
    neighborhood_columns_px: int = 60
    # How far up and down a patch may be mistaken.
    neighborhood_rows_px: int = 16

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each of `FEATURES`."""
        return {name: float(getattr(self, f'weight_{name}')) for name in FEATURES}

    def alone(self, feature: str) -> AttentionConfig:
        """
        Let one of `FEATURES` alone attract attention.

        Raises `LandmarkNavError`: unknown feature.
        """
        if feature not in FEATURES:
            raise LandmarkNavError(
                f'attention knows no feature {feature!r}: take one of {", ".join(FEATURES)}'
            )
        weights: dict[str, Any] = {f'weight_{name}': float(name == feature) for name in FEATURES}
        return replace(self, **weights)

    @property
    def sizes_px(self) -> tuple[int, ...]:
        """Widths and heights to choose from, rising."""
        return tuple(range(self.size_min_px, self.size_max_px + 1, self.size_step_px))
