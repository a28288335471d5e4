"""
Whether the wall map fits what the panoramas see.

Stereo alone, without the walls, says where patches lie. What hangs on a wall lies a little before
it, all along it; a wall that is wrong in `room.yaml` has its patches elsewhere, or at an angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import theilslopes

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment import Adjustment
from landmark_nav.parameters import check_parameters, parameter
from landmark_nav.types import FloatArray

__all__ = ['WallFitConfig', 'check_walls']


@dataclass(frozen=True)
class WallFitConfig:
    """When a wall of the map is called wrong."""

    max_before_m: float = parameter(
        0.045, 'farthest that things hang before a wall, median, metres', minimum=0, maximum=1
    )
    max_behind_m: float = parameter(
        0.02, 'farthest that they seem to hang behind it, median, metres', minimum=0, maximum=1
    )
    max_turn_rad: float = parameter(
        0.03, 'greatest angle between patches and their wall', minimum=0, maximum=1
    )
    min_patches: int = parameter(
        6, 'patches that it takes to judge a wall', minimum=3, maximum=1000
    )
    max_sigma_m: float = parameter(
        0.02, 'least certain patch that counts, standard deviation', minimum=1e-4, maximum=1
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_parameters(self)


def check_walls(free: Adjustment, walls: Sequence[int], room: Room, config: WallFitConfig) -> None:
    """
    Compare patches, placed without the walls, with the walls.

    Parameters
    ----------
    free : Adjustment
        Patches placed by stereo alone.
    walls : sequence of int
        The wall each was looked for on.
    room : Room
        The wall map.
    config : WallFitConfig
        Bounds.

    Raises
    ------
    LandmarkNavError
        Walls that don't fit, each with its residuals.

    """
    index = np.asarray(walls, dtype=np.intp)
    sigma = np.sqrt(
        np.einsum('ni,nij,nj->n', room.normals[index], free.own_covariance, room.normals[index])
    )
    complaints = []
    for k, wall in enumerate(room.walls):
        # What stands well before the wall is furniture and says nothing about it.
        on = (index == k) & (sigma < config.max_sigma_m) & (np.abs(free.off_wall_m) < 0.3)
        if np.sum(on) < config.min_patches:
            continue
        side = np.subtract(wall.end, wall.start) / wall.length
        along = (free.positions[on, :2] - wall.start) @ side
        complaint = _complaint(along, free.off_wall_m[on], config)
        if complaint:
            complaints.append(f'{wall.id} {complaint}')
    if complaints:
        raise LandmarkNavError(
            f'the walls do not fit what the panoramas see: {"; ".join(complaints)}: '
            'measure walls and papers again and mend room.yaml'
        )


def _complaint(along_m: FloatArray, off_m: FloatArray, config: WallFitConfig) -> str:
    median = float(np.median(off_m))
    spread = float(np.median(np.abs(off_m - median)))
    slack = 2.0 * spread / np.sqrt(len(off_m))
    if not -config.max_behind_m - slack <= median <= config.max_before_m + slack:
        place = 'before' if median > 0 else 'behind'
        return (
            f'has its {len(off_m)} patches {abs(median) * 100:.1f} cm {place} it '
            f'(+-{spread * 100:.1f} cm)'
        )
    if np.ptp(along_m) < 1.0:
        return ''
    slope, _, low, high = theilslopes(off_m, along_m)
    if min(abs(low), abs(high)) > config.max_turn_rad and low * high > 0.0:
        return f'is turned by {np.degrees(np.arctan(abs(slope))):.1f} deg against its patches'
    return ''
