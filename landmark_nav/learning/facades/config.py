"""Parameters of facades."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config


@dataclass(frozen=True)
class FacadesConfig(Config):
    """What counts as a flat vertical surface, and its uncertainty."""

    # Sigma of points of a facade about its plane, m.
    relief_m: float = 0.015
    # Fewest cells of 10 cm x 10 cm of a facade that contain points.
    min_cells: int = 12
    # Least length, m.
    min_length_m: float = 0.4
    # Longest part of a facade without points, m.
    max_gap_m: float = 1.2
    # Least height of walls, m: their tops are not observed.
    wall_height_m: float = 2.5
    # Sigma of a facade before adjustment, m.
    sigma_m: float = 0.03
    # Most facades of a room.
    max_facades: int = 24
