"""Parameters of facades."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config


@dataclass(frozen=True)
class FacadesConfig(Config):
    """What counts as a flat vertical surface, and how well it is known."""

    # How far off its plane things on a facade are.
    relief_m: float = 0.015
    # Least cells of 10 cm x 10 cm of a facade that hold points.
    min_cells: int = 12
    # Least length.
    min_length_m: float = 0.4
    # Longest stretch of a facade without points.
    max_gap_m: float = 1.2
    # Height that walls have at least, as nothing shows their top.
    wall_height_m: float = 2.5
    # Standard deviation of a facade that is found, before adjustment.
    sigma_m: float = 0.03
    # Most facades of a room.
    max_facades: int = 24
