"""Parameters of attention."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from landmark_nav.errors import LandmarkNavError
from landmark_nav.parameters import check_order, Config, parameter

__all__ = ['FEATURES', 'AttentionConfig']

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

    Raises
    ------
    LandmarkNavError
        A value out of its range, sizes in the wrong order, or no weight at all.

    """

    weight_intensity: float = parameter(0.0, 'weight of bright areas', minimum=0, maximum=10)
    weight_edges: float = parameter(0.25, 'weight of Canny edges', minimum=0, maximum=10)
    weight_vertical_edges: float = parameter(
        0.0, 'weight of vertical edges, which fix a bearing', minimum=0, maximum=10
    )
    weight_corners: float = parameter(0.2, 'weight of corners', minimum=0, maximum=10)
    weight_symmetry: float = parameter(
        0.25, 'weight of symmetry about a point', minimum=0, maximum=10
    )
    weight_radial_symmetry: float = parameter(
        0.2, 'weight of symmetry about a point that edges vote for', minimum=0, maximum=10
    )
    weight_line_symmetry: float = parameter(
        0.1, 'weight of symmetry about vertical lines', minimum=0, maximum=10
    )
    edge_low: float = parameter(
        4.0, 'gradient at which an edge goes on, grey levels per px', minimum=0.5, maximum=100
    )
    edge_high: float = parameter(
        10.0, 'gradient at which an edge starts, grey levels per px', minimum=0.5, maximum=100
    )
    size_min_px: int = parameter(28, 'least width and height of a patch, px', minimum=12)
    size_max_px: int = parameter(32, 'largest width and height of a patch, px', maximum=128)
    size_step_px: int = parameter(2, 'step between sizes, px', minimum=1)
    candidates: int = parameter(120, 'patches per panorama at most', minimum=1)
    least_response: float = parameter(
        0.1, 'stop where the response falls below this share of the first', minimum=0, maximum=1
    )
    candidates_per_sector: int = parameter(12, 'patches per sector at most', minimum=1)
    neighborhood_columns_px: int = parameter(
        60, 'how far to either side a patch may be mistaken', minimum=8, maximum=400
    )
    neighborhood_rows_px: int = parameter(
        16, 'how far up and down a patch may be mistaken', minimum=0, maximum=400
    )
    ambiguity_max: float = parameter(
        0.75, 'largest correlation with another place near by', minimum=0, maximum=1
    )
    noise_gray: float = parameter(
        3.0, 'noise of one frame, standard deviation in grey levels', minimum=0.1, maximum=50
    )

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if not any(self.weights.values()):
            raise LandmarkNavError('all weights of AttentionConfig are 0: raise at least one')
        check_order(self, 'edge_low', 'edge_high')
        check_order(self, 'size_min_px', 'size_max_px')

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each of `FEATURES`."""
        return {name: float(getattr(self, f'weight_{name}')) for name in FEATURES}

    def alone(self, feature: str) -> AttentionConfig:
        """
        Let one of `FEATURES` alone attract attention.

        Raises
        ------
        LandmarkNavError
            Unknown feature.

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
