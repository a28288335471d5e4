"""
Check of the plan against the panoramas; uncertain walls are moved to the patches.

Stereo alone, without the walls, gives the positions of patches. Objects on a wall lie slightly in
front of it, all along it; patches of a wall that is wrong in `room.yaml` are elsewhere, or at an
angle. The adjustment trusts the panoramas more than the walls, so that landmarks are right anyway:
uncertain walls cause a warning, and walls that are certainly wrong a refusal.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from landmark_nav.arrays import BoolArray
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.se2 import cross, crossing
from landmark_nav.geometry.walls import Room, Wall
from landmark_nav.learning.adjustment.problem import AdjustmentConfig, wall_sections
from landmark_nav.learning.adjustment.solution import Adjustment
from landmark_nav.learning.least_squares import covariance_of
from landmark_nav.learning.right_angles import common_direction, pull
from landmark_nav.types import FloatArray

# Greatest median distance of patches in front of a wall and behind it, m, and greatest angle
# between patches and their wall.
_MAX_BEFORE_M, _MAX_BEHIND_M, _MAX_TURN_RAD = 0.045, 0.02, 0.03
# Rate of false warnings about measured walls, and fewest patches of a warning.
_FALSE_ALARM = 1e-3
_FEW = 2
# A wall is refused if it exceeds a bound by this number of sigmas.
_SURE = 3.0
# Fewest objects of which one can be found to be an outlier.
_LEAST_OBJECTS = 3
# Fewest patches of a refusal, and their least extent along the wall, m.
_MIN_PATCHES = 6
_MIN_EXTENT_M = 1.0
# Patches farther from a wall, or less certain, are not used.
_MAX_DISTANCE_M = 0.2
_MAX_SIGMA_M = 0.02
# If far more patches lie in one plane at a distance in this range than near the wall, that plane
# is the wall. In front of a wall it may be furniture, but hardly along such a share of a wall on
# which nothing else is visible; behind a wall it can be nothing else, and patches near the wall
# may be furniture.
_ELSEWHERE_M = (0.15, 1.5)
_NEAR_M = 0.1
_SURE_SHARE = 0.5
_MOST_NEAR_IF_BEFORE, _MOST_NEAR_IF_BEHIND = 0.1, 0.5
# Three quarters of the objects on a wall lie within this distance of one plane, or within this
# share of its distance from the wall: positions far from the assumed wall are less certain.
_MAX_SPREAD_M = 0.025
_MAX_SPREAD_SHARE = 0.1


def check_walls(
    free: Adjustment, walls: Sequence[int], room: Room, expected: AdjustmentConfig
) -> str:
    """
    Compare patches in an adjustment without walls with the `walls` behind them, -1 for none.

    The text is a warning about walls that furniture may hide or that may be elsewhere, or empty.

    Raises `LandmarkNavError`: walls do not fit; each is named with its residuals.
    """
    complaints: list[str] = []
    warnings: list[str] = []
    # Also of patches on planes of their own.
    index = np.asarray(walls, dtype=np.intp)
    starts = np.array([wall.start for wall in room.walls])[index]
    off_m = np.sum((free.positions[:, :2] - starts) * room.normals[index, :2], 1)
    free = replace(free, off_wall_m=off_m)
    for k, on in _judged(free, walls, room, _MIN_PATCHES, elsewhere=True):
        objects = _objects(free, room, k, on, expected.hanging_length_m)
        shared = np.linalg.norm(room.normals[k] @ free.shared_loading[on].mean(0))
        sigma = float(np.hypot(shared, room.walls[k].sigma_m or 0.0))
        complaint = _complaint(objects, sigma, expected.hanging_sigma_m, int(on.sum()))
        if complaint:
            wall, before = room.walls[k], np.median(free.off_wall_m[on]) > _ELSEWHERE_M[0]
            seen = np.ptp(free.positions[on, :2] @ wall.along)
            hidden = before and seen < _SURE_SHARE * wall.length
            (warnings if hidden else complaints).append(f'{wall.id} {complaint}')
    if complaints:
        raise LandmarkNavError(
            f'the walls do not fit what the panoramas see: {"; ".join(complaints)}: '
            'measure walls and papers again and fix room.yaml'
        )
    return f'room.yaml may be wrong: {"; ".join(warnings)}' if warnings else ''


@dataclass(frozen=True, eq=False)
class WallResidual:
    """
    Median distance of objects from a wall, over its `sections` with patches.

    `shared` (m,) are its loadings by the shared factors; `wall_sigma_m` is the sigma of the wall,
    if the plan gives it.
    """

    wall_id: str
    patches: int
    sections: int
    off_m: float
    shared: FloatArray
    wall_sigma_m: float | None = None

    @property
    def sigma_m(self) -> float:
        """Sigma of `off_m` by the shared factors."""
        return float(np.linalg.norm(self.shared))


def wall_residuals(
    adjustment: Adjustment, walls: Sequence[int], room: Room, expected: AdjustmentConfig
) -> tuple[WallResidual, ...]:
    """Return the distances of patches from their walls; arguments as for `check_walls`."""
    residuals = []
    for k, on in _judged(adjustment, walls, room, _FEW):
        off = _objects(adjustment, room, k, on, expected.hanging_length_m)[:, 1]
        wall, median = room.walls[k], float(np.median(off))
        shared = room.normals[k] @ adjustment.shared_loading[on].mean(0)
        patches = int(on.sum())
        residuals.append(WallResidual(wall.id, patches, len(off), median, shared, wall.sigma_m))
    return tuple(residuals)


def wall_warnings(
    residuals: Sequence[WallResidual], hanging_sigma_m: float, expected: AdjustmentConfig
) -> str:
    """
    Warning if the walls, together or relative to each other, hardly fit the plan; else empty.

    `hanging_sigma_m` is the sigma of the distance of objects from a wall in this room.
    """
    if not residuals:
        return ''
    off = np.array([residual.off_m for residual in residuals])
    shared = np.stack([residual.shared for residual in residuals])
    sections = np.array([residual.sections for residual in residuals])
    walls = np.array([residual.wall_sigma_m or 0.0 for residual in residuals])
    measured = np.where(walls > 0.0, walls, expected.wall_sigma_m)
    # The variance of a median is pi / 2 times that of a mean.
    apart = measured**2 + 0.5 * np.pi * hanging_sigma_m**2 / sections
    inverse = covariance_of(shared @ shared.T + np.diag(apart))
    left = off - np.sum(inverse @ off) / inverse.sum()
    likely = chdtrc(max(len(off) - 1, 1), left @ inverse @ left) > _FALSE_ALARM
    # A single object may be as far from the wall as its frame is deep; the mean of many is not.
    slack = 2.0 * np.sqrt(np.sum(shared**2, 1) + hanging_sigma_m**2 / sections**2 + walls**2)
    near = (off >= -_MAX_BEHIND_M - slack) & (off <= _MAX_BEFORE_M + slack)
    if likely and near.all():
        return ''
    listed = ', '.join(
        f'{100 * abs(r.off_m):.1f} cm {"before" if r.off_m > 0 else "behind"} {r.wall_id}'
        for r in residuals
    )
    # What hangs away from a wall, as blinds do, lies before it, never behind.
    worst = int(np.argmax(np.abs(left)))
    hung = 'things may hang away from the walls, or ' if off[worst] > 0.0 else ''
    return (
        f'{hung}room.yaml may be wrong: what hangs on the walls lies {listed}; landmarks are '
        'where the panoramas see them, but measure the walls again'
    )


def _judged(
    adjustment: Adjustment, walls: Sequence[int], room: Room, least: int, elsewhere: bool = False
) -> Iterator[tuple[int, BoolArray]]:
    """Walls with `least` patches near them or, with `elsewhere`, near a likelier plane; masks."""
    index = np.asarray(walls, dtype=np.intp)
    normal = room.normals[index]
    sigma = np.sqrt(np.einsum('ni,nij,nj->n', normal, adjustment.own_covariance, normal))
    off = adjustment.off_wall_m
    for k, wall in enumerate(room.walls):
        precise = (index == k) & (sigma < _MAX_SIGMA_M)
        plane = _likelier_plane(off[precise]) if elsewhere else 0.0
        # Patches far in front of the wall are furniture.
        on = precise & (np.abs(off - plane) < _MAX_DISTANCE_M)
        along = adjustment.positions[on, :2] @ wall.along
        if on.sum() >= least and np.ptp(along) >= _MIN_EXTENT_M:
            yield k, on


def _likelier_plane(off_m: FloatArray) -> float:
    """Distance of the plane of most patches (n,) from their wall; 0 if some are on the wall."""
    if not len(off_m):
        return 0.0
    neighbours = np.sum(np.abs(off_m[:, None] - off_m) < _MAX_SPREAD_M, 1)
    plane = float(np.median(off_m[neighbours == neighbours.max()]))
    most_near = _MOST_NEAR_IF_BEFORE if plane > 0.0 else _MOST_NEAR_IF_BEHIND
    far_more = np.sum(np.abs(off_m) < _NEAR_M) <= most_near * neighbours.max()
    return plane if far_more and _ELSEWHERE_M[0] < abs(plane) < _ELSEWHERE_M[1] else 0.0


def _objects(
    adjustment: Adjustment, room: Room, k: int, on: BoolArray, length_m: float
) -> FloatArray:
    """Medians (n, 2) of the sections of wall `k`: position along the wall, distance from it."""
    wall, positions = room.walls[k], adjustment.positions[on]
    along = (positions[:, :2] - wall.start) @ wall.along
    patches = np.stack([along, adjustment.off_wall_m[on]], 1)
    # Patches of one object are not independent, so a section counts once.
    section = wall_sections(positions, [k] * len(positions), room, length_m)
    return np.array([np.median(patches[section == n], 0) for n in range(section.max() + 1)])


def _complaint(objects: FloatArray, sigma_m: float, hanging_sigma_m: float, patches: int) -> str:
    """Complaint about a wall; empty unless its objects lie in one plane."""
    along, off = objects.T
    if len(objects) < _LEAST_OBJECTS:
        return ''
    # Theil-Sen (Sen, JASA 63(324), 1968); scipy.stats would take half a second to import.
    one, other = np.triu_indices(len(objects), 1)
    apart = along[other] - along[one]
    slope = float(np.median((off[other] - off[one])[apart != 0.0] / apart[apart != 0.0]))
    straightened = off - slope * along
    spread = float(np.quantile(np.abs(straightened - np.median(straightened)), 0.75))
    median = float(np.median(off))
    if spread > max(_MAX_SPREAD_M, _MAX_SPREAD_SHARE * abs(median)):
        return ''
    apart = np.sqrt(np.sum((along - along.mean()) ** 2))
    turned = np.hypot(hanging_sigma_m / apart, sigma_m / np.ptp(along))
    if abs(slope) > _MAX_TURN_RAD + _SURE * turned:
        return f'is turned by {np.degrees(np.arctan(abs(slope))):.1f} deg against its patches'
    slack = _SURE * sigma_m
    if -_MAX_BEHIND_M - slack <= median <= _MAX_BEFORE_M + slack:
        return ''
    place = 'before' if median > 0 else 'behind'
    furniture = ', or furniture hides it, whose front is then the wall'
    return (
        f'has its {patches} patches {abs(median) * 100:.1f} cm {place} it '
        f'(+-{spread * 100:.1f} cm){furniture if median > _MAX_DISTANCE_M else ""}'
    )


_STEPS = 10
# Scale of the robust weight, in sigmas.
_TAIL_WIDTH = 2.0
# Least angle between neighbours whose intersection is their corner, rad.
_LEAST_CORNER_RAD = 0.2


def moved_walls(
    free: Adjustment, walls: Sequence[int], room: Room, config: AdjustmentConfig
) -> tuple[Room, float]:
    """
    Move walls that have a `sigma_m`, that of each end, to the patches on them.

    Arguments are those of `check_walls`. Returned are the room, the same if no such wall has
    patches, and the greatest shift of the end of a wall along its normal, m.
    """
    index = np.asarray(walls, dtype=np.intp)
    seen = [k for k, wall in enumerate(room.walls) if wall.sigma_m and np.any(index == k)]
    if not seen:
        return room, 0.0
    section = wall_sections(free.positions, walls, room, config.hanging_length_m)
    # Patches of one section of a wall hang equally far from it.
    hanging = np.asarray(config.hanging_sigma_m**2 * np.bincount(section)[section], np.float64)
    fitted = [_fitted(w, free, index == k, hanging, config) for k, w in enumerate(room.walls)]
    moves, covariance = (np.array(part) for part in zip(*fitted, strict=True))
    moves[seen] = _squared([room.walls[k] for k in seen], moves[seen], covariance[seen])
    given = np.array([(wall.start, wall.end) for wall in room.walls])
    # The wall that starts where each one ends.
    after = [int(np.argmin(np.hypot(*(given[:, 0] - end).T))) for end in given[:, 1]]
    starts, ends = np.moveaxis(given + moves[..., None] * room.normals[:, None, :2], 1, 0)
    corners = [
        tuple(_crossing(starts[k], ends[k], starts[n], ends[n]).tolist())
        for k, n in enumerate(after)
    ]
    # The distance of objects from the wall is an error that all patches share.
    sigmas = np.sqrt(covariance[:, [0, 1], [0, 1]].max(1) + config.common_hanging_sigma_m**2)
    moved = [
        replace(wall, start=corners[before], end=corner, sigma_m=wall.sigma_m and sigma)
        for wall, before, corner, sigma in zip(
            room.walls, np.argsort(after), corners, sigmas.tolist(), strict=True
        )
    ]
    return replace(room, walls=tuple(moved)), float(np.abs(moves).max())


def _fitted(
    wall: Wall, free: Adjustment, on: BoolArray, hanging_m2: FloatArray, config: AdjustmentConfig
) -> tuple[FloatArray, FloatArray]:
    """Shift (2,) of both ends of a wall along its normal by patches `on` it; its covariance."""
    if not wall.sigma_m:
        return np.zeros(2), np.zeros((2, 2))
    normal = wall.normal[:2]
    off = free.positions[on, :2] - wall.start
    share = off @ wall.along / wall.length
    design = np.stack([1.0 - share, share], 1)
    variance = np.einsum('i,nij,j->n', normal, free.own_covariance[on, :2, :2], normal)
    variance += config.relief_sigma_m**2 + hanging_m2[on]
    prior = np.eye(2) / wall.sigma_m**2
    ends, information, tail = np.zeros(2), prior, variance + wall.sigma_m**2
    for _ in range(_STEPS):
        miss = off @ normal - design @ ends
        # False matches and furniture do not move the wall (Geman and McClure).
        weight = (1.0 + miss**2 / (_TAIL_WIDTH**2 * tail)) ** -2.0 / variance
        information = prior + (design * weight[:, None]).T @ design
        ends = np.linalg.solve(information, design.T @ (weight * (off @ normal)))
        tail = np.maximum(variance, 0.5 * tail)
    return ends, covariance_of(information)


def _squared(walls: Sequence[Wall], ends_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """Shifts (n, 2) of the ends of walls, with the prior that most walls are at right angles."""
    # What hangs on a short wall at various depths hardly shows its direction.
    across = np.array([[-1.0, 1.0]]) / np.array([[wall.length] for wall in walls])
    given = np.array([np.arctan2(*wall.along[1::-1]) for wall in walls])
    turned = given + np.sum(across * ends_m, 1)
    spread = np.einsum('ni,nij->nj', across, covariance)
    variance = np.sum(spread * across, 1)
    common = common_direction(turned, variance, np.array([wall.length for wall in walls]))
    return np.asarray(ends_m - spread * pull(turned, variance, common)[:, None])


def _crossing(
    start: FloatArray, end: FloatArray, other: FloatArray, other_end: FloatArray
) -> FloatArray:
    """Corner (2,) of a wall and the one after it."""
    along, after = end - start, other_end - other
    if abs(cross(along, after)) < _LEAST_CORNER_RAD * np.hypot(*along) * np.hypot(*after):
        return np.asarray(0.5 * (end + other))
    return crossing(start, along, other, after)
