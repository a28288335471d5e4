"""
Whether the wall map fits what the panoramas see.

Stereo alone, without the walls, says where patches lie. What hangs on a wall lies a little before
it, all along it; a wall that is wrong in `room.yaml` has its patches elsewhere, or at an angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment.solution import Adjustment
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
    min_extent_m: float = parameter(
        1.0, 'how far along a wall they must spread, metres', minimum=0, maximum=100
    )
    max_distance_m: float = parameter(
        0.2, 'what stands farther before or behind says nothing', minimum=0, maximum=1
    )
    max_spread_m: float = parameter(
        0.012, 'median distance from one plane that patches of a wall keep', minimum=0, maximum=1
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
    normal = room.normals[index]
    sigma = np.sqrt(np.einsum('ni,nij,nj->n', normal, free.own_covariance, normal))
    shared = np.einsum('ni,nip->np', normal, free.shared_loading)
    complaints = []
    for k, wall in enumerate(room.walls):
        # What stands well before the wall is furniture and says nothing about it.
        near = np.abs(free.off_wall_m) < config.max_distance_m
        on = (index == k) & (sigma < config.max_sigma_m) & near
        along = (free.positions[on, :2] - wall.start) @ np.subtract(wall.end, wall.start)
        along /= wall.length
        if np.sum(on) < config.min_patches or np.ptp(along) < config.min_extent_m:
            continue
        slack = 3.0 * float(np.linalg.norm(shared[on].mean(0)))
        complaint = _complaint(along, free.off_wall_m[on], slack, config)
        if complaint:
            complaints.append(f'{wall.id} {complaint}')
    if complaints:
        raise LandmarkNavError(
            f'the walls do not fit what the panoramas see: {"; ".join(complaints)}: '
            'measure walls and papers again and mend room.yaml'
        )


def _complaint(
    along_m: FloatArray, off_m: FloatArray, slack_m: float, config: WallFitConfig
) -> str:
    """What is wrong with a wall; nothing unless its patches lie in one plane, as a wall's do."""
    slope, low, high = _slope(along_m, off_m)
    straightened = off_m - slope * along_m
    spread = float(np.median(np.abs(straightened - np.median(straightened))))
    if spread > config.max_spread_m:
        return ''
    if (
        min(abs(low), abs(high)) > config.max_turn_rad + slack_m / np.ptp(along_m)
        and low * high > 0
    ):
        return f'is turned by {np.degrees(np.arctan(abs(slope))):.1f} deg against its patches'
    median = float(np.median(off_m))
    if -config.max_behind_m - slack_m <= median <= config.max_before_m + slack_m:
        return ''
    place = 'before' if median > 0 else 'behind'
    return (
        f'has its {len(off_m)} patches {abs(median) * 100:.1f} cm {place} it '
        f'(+-{spread * 100:.1f} cm)'
    )


def _slope(x: FloatArray, y: FloatArray) -> tuple[float, float, float]:
    """Median slope between any two points and its 95 % interval (Sen, JASA 63, 1968)."""
    left, right = np.nonzero(x[:, None] < x)
    slopes = np.sort((y[right] - y[left]) / (x[right] - x[left]))
    count = len(x)
    half = 0.5 * 1.96 * np.sqrt(count * (count - 1) * (2 * count + 5) / 18.0)
    ranks = np.rint(0.5 * len(slopes) + np.array([-half - 1.0, half])).astype(int)
    low, high = slopes[np.clip(ranks, 0, len(slopes) - 1)]
    return float(np.median(slopes)), float(low), float(high)
