"""Parameters of facades."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter

__all__ = ['FacadesConfig']


@dataclass(frozen=True)
class FacadesConfig(Config):
    """What counts as a flat vertical surface, and how well it is known."""

    relief_m: float = parameter(
        0.015, 'how far off its plane things on a facade are', minimum=1e-4, maximum=0.5
    )
    min_cells: int = parameter(
        12, 'least cells of 10 cm x 10 cm of a facade that hold points', minimum=3, maximum=1000
    )
    min_length_m: float = parameter(0.4, 'least length', minimum=0.05, maximum=10)
    max_gap_m: float = parameter(
        1.2, 'longest stretch of a facade without points', minimum=0.05, maximum=20
    )
    wall_height_m: float = parameter(
        2.5, 'height that walls have at least, as nothing shows their top', minimum=0.5, maximum=50
    )
    sigma_m: float = parameter(
        0.03, 'standard deviation of a facade that is found, before adjustment', minimum=1e-3
    )
    max_facades: int = parameter(24, 'most facades of a room', minimum=3, maximum=200)
