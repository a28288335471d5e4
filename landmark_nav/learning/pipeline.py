"""
Learning, stage by stage.

`sweep_pipeline` leads from each sweep to its panorama;
panoramas -> candidates -> wall patches -> measurements -> adjustment -> election -> map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import logging

import cv2
import numpy as np

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment import (
    adjust,
    Adjustment,
    AdjustmentConfig,
    CALIBRATED,
    depth_from_scale,
    WallFitConfig,
)
from landmark_nav.learning.adjustment.wall_fit import (
    check_walls,
    moved_walls,
    wall_residuals,
    wall_warnings,
    WallResidual,
)
from landmark_nav.learning.attention import attend, AttentionConfig
from landmark_nav.learning.election import elect, ElectionConfig
from landmark_nav.learning.least_squares import checked_covariance
from landmark_nav.learning.reference_area import joint_covariance, ReferenceAreaConfig
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.stereo import StereoConfig
from landmark_nav.learning.stereo.found_again import find_again, Found
from landmark_nav.learning.stereo.ties import Ties
from landmark_nav.parameters import Config
from landmark_nav.types import (
    Candidate,
    FloatArray,
    Landmark,
    LandmarkMap,
    Panorama,
    Refusal,
)

_LOG = logging.getLogger(__name__)

# Standard deviations of a panorama that no map can be learned with: metres and radians.
_MOST_SIGMA = np.array([1.0, 1.0, 1.0, 0.3])
# Three landmarks make one triplet, which is not in view from everywhere.
_FEW = 3
# So far from its wall a patch may be when stereo alone places it.
_NO_WALL_M = 1.0
# Weight of expected sigmas that leaves nothing to estimate.
_AS_EXPECTED = 1e9


@dataclass(frozen=True)
class LearningConfig(Config):
    """Parameters of the stages from panoramas to map."""

    attention: AttentionConfig = field(default_factory=AttentionConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    wall_fit: WallFitConfig = field(default_factory=WallFitConfig)
    election: ElectionConfig = field(default_factory=ElectionConfig)
    reference_area: ReferenceAreaConfig = field(default_factory=ReferenceAreaConfig)


@dataclass(frozen=True, eq=False)
class LearningResult:
    """
    What was learned and what became of every candidate.

    `panoramas` carry their adjusted poses. `candidates` and `outcomes` have one tuple a
    panorama, in the same order: the elected `Landmark` or why there is none. `ambiguous` holds,
    a tuple a panorama too, why attention refused others before. `walls` holds how far before each
    wall what hangs there lies, where enough does, and `warning` whether these walls may be wrong.
    """

    map: LandmarkMap
    panoramas: tuple[Panorama, ...]
    candidates: tuple[tuple[Candidate, ...], ...]
    outcomes: tuple[tuple[Landmark | Refusal, ...], ...]
    reconstructed: int
    ambiguous: tuple[tuple[Refusal, ...], ...] = ()
    walls: tuple[WallResidual, ...] = ()
    warning: str = ''


def learn_from_panoramas(
    panoramas: Sequence[Panorama],
    room: Room,
    config: LearningConfig,
    log: StageLog | None = None,
    places: FloatArray | None = None,
    ties: Ties | None = None,
) -> LearningResult:
    """
    Learn landmarks from two panoramas or more.

    Raises `LandmarkNavError`: one panorama only, all from one place, walls that don't fit, or no
    landmark at all.

    Parameters
    ----------
    panoramas : sequence of Panorama
        From v places.
    log : StageLog, optional
        Where times go.
    places : ndarray, shape (4 v, 4 v), optional
        Joint covariance of the viewpoints before there are measurements; without it they were
        measured from papers, or each for itself.
    ties : Ties, optional
        Features that panoramas share.
    """
    _check(panoramas)
    log = log or StageLog()
    greys = [
        np.asarray(cv2.cvtColor(p.image, cv2.COLOR_BGR2GRAY), dtype=np.float32) for p in panoramas
    ]
    with log.measure('attention'):
        matched = [
            ties.pixels(k, p.cylinder) if ties is not None else None
            for k, p in enumerate(panoramas)
        ]
        attended = [
            attend(p, config.attention, at) for p, at in zip(panoramas, matched, strict=True)
        ]
        candidates = tuple(a.candidates for a in attended)

    if places is None:
        places = joint_covariance(panoramas, room, config.reference_area)
    with log.measure('stereo'):
        found = find_again(panoramas, candidates, greys, room, config.stereo, ties)
        if any(wall.sigma_m for wall in room.walls) and found.patches:
            free = _adjust(found, panoramas, places, room, _without_walls(config), ties)
            moved = moved_walls(free, found.walls, room, config.adjustment)
            if moved is not room:
                room = moved
                found = find_again(panoramas, candidates, greys, room, config.stereo, ties)
    outcomes = found.outcomes
    if len(found.patches) < 3:
        raise LandmarkNavError(
            f'{len(found.patches)} of {sum(map(len, candidates))} candidates were found again '
            f'from another place ({_reasons(outcomes)}): take panoramas 1 to 3 m apart that see '
            'the same textured walls, and check room.yaml'
        )
    with log.measure('adjustment'):
        adjustment, free, residuals, hidden = _adjusted(
            found, panoramas, places, room, config, ties
        )
    uneven = wall_warnings(
        residuals, adjustment.hanging_sigma_m, config.adjustment, config.wall_fit
    )
    warning = '; '.join(filter(None, [hidden, uneven]))
    if warning:
        _LOG.warning('%s', warning)
    adjusted = tuple(
        replace(p, center_map=pose[:3], heading_rad=float(pose[3]), covariance=covariance)
        for p, pose, covariance in zip(
            panoramas, adjustment.poses, adjustment.pose_covariance, strict=True
        )
    )
    with log.measure('election'):
        elected = elect(
            found.patches,
            found.measurements,
            adjustment,
            free,
            adjusted,
            greys,
            room,
            config.election,
        )
    for (i, n), outcome in zip(found.origin, elected, strict=True):
        outcomes[i][n] = outcome
    landmarks = sorted((e for e in elected if isinstance(e, Landmark)), key=lambda e: e.id)
    if not landmarks:
        raise LandmarkNavError(
            f'no landmark elected ({_reasons(outcomes)}): check that room.yaml fits the room'
        )
    if len(landmarks) <= _FEW:
        _LOG.warning(
            '%d landmarks are too few to localize by, which takes a triplet in view (%s): take '
            'more panoramas',
            len(landmarks),
            _reasons(outcomes),
        )
    return LearningResult(
        LandmarkMap(
            tuple(landmarks),
            room.frame_id,
            room.walls,
            tuple(view.axis for view in adjusted),
            calibration=_calibration(panoramas, adjustment, config),
        ),
        adjusted,
        candidates,
        tuple(tuple(o) for o in outcomes),
        len(found.patches),
        tuple(tuple(why for _, why in a.refused) for a in attended),
        residuals,
        warning,
    )


def _without_walls(config: LearningConfig) -> AdjustmentConfig:
    return replace(
        config.adjustment,
        relief_sigma_m=_NO_WALL_M,
        camera_weight=_AS_EXPECTED,
        place_weight=_AS_EXPECTED,
        room_weight=_AS_EXPECTED,
    )


def _adjust(
    found: Found,
    panoramas: Sequence[Panorama],
    places: FloatArray,
    room: Room,
    expected: AdjustmentConfig,
    ties: Ties | None,
) -> Adjustment:
    start = np.array([patch.position for patch in found.patches])
    return adjust(
        found.measurements,
        found.walls,
        start,
        panoramas,
        places,
        room,
        expected,
        found.normals,
        ties,
    )


def _adjusted(
    found: Found,
    panoramas: Sequence[Panorama],
    places: FloatArray,
    room: Room,
    config: LearningConfig,
    ties: Ties | None,
) -> tuple[Adjustment, Adjustment, tuple[WallResidual, ...], str]:
    """Adjust with the walls and without; how far before each wall things lie, and what is odd."""
    without_walls = _without_walls(config)
    hidden = ''
    if ties is None:  # otherwise walls were found, and nobody says that they are right
        behind = found.before_walls
        placed = _adjust(behind, panoramas, places, room, without_walls, ties)
        hidden = check_walls(placed, behind.walls, room, config.adjustment, config.wall_fit)
    walls = found.walls
    free = _adjust(found, panoramas, places, room, without_walls, ties)
    adjustment = _adjust(found, panoramas, places, room, config.adjustment, ties)
    residuals = wall_residuals(adjustment, walls, room, config.adjustment)
    adjustment, free = depth_from_scale(
        adjustment,
        free,
        found.measurements,
        found.normals,
        config.adjustment,
        config.election.max_depth_sigma_m,
    )
    return adjustment, free, residuals, hidden


def _calibration(
    panoramas: Sequence[Panorama], adjustment: Adjustment, config: LearningConfig
) -> Calibration | None:
    """Calibration after the last panorama, with what the adjustment found in all of them."""
    known = panoramas[-1].calibration
    if known is None or not len(adjustment.calibration):
        return known
    which = [NAMES.index(name) for name in CALIBRATED]
    values, covariance = known.values.copy(), known.covariance.copy()
    values[which] = adjustment.calibration
    covariance[which] = covariance[:, which] = 0.0
    covariance[np.ix_(which, which)] = adjustment.calibration_covariance
    # What the base leans on the floor where the panoramas were taken is no part of the mount.
    axis_tilt = [NAMES.index(name) for name in ('axis_roll', 'axis_pitch')]
    covariance[axis_tilt, axis_tilt] += config.reference_area.horizon_sigma_rad**2 / len(panoramas)
    by_map = np.zeros((len(NAMES), adjustment.shared_loading.shape[2]))
    by_map[which] = adjustment.calibration_loading
    return replace(known, values=values, covariance=covariance, by_map=by_map)


def _check(panoramas: Sequence[Panorama]) -> None:
    if len(panoramas) < 2:
        raise LandmarkNavError(
            f'learning needs two panoramas from different places, not {len(panoramas)}: '
            'take another sweep 1 to 3 m away'
        )
    for p in panoramas:
        if not np.isfinite([*p.center_map, p.heading_rad]).all():
            raise LandmarkNavError('panorama/pose is not a number: mend its publisher')
        checked_covariance(p.covariance, _MOST_SIGMA, 'panorama/pose')
    centers = np.array([p.center_map[:2] for p in panoramas])
    spread = float(np.max(np.linalg.norm(centers[:, None] - centers[None], axis=-1)))
    if spread < 0.2:
        raise LandmarkNavError(
            f'all {len(panoramas)} panoramas are from one place (within {spread:.2f} m): '
            'take another sweep 1 to 3 m away'
        )


def _reasons(outcomes: Sequence[Sequence[Landmark | Refusal]]) -> str:
    """Count the refusals, the commonest first."""
    reasons = [o.reason for group in outcomes for o in group if isinstance(o, Refusal)]
    ranked = sorted(set(reasons), key=lambda r: -reasons.count(r))
    return ', '.join(f'{reasons.count(r)} {r}' for r in ranked)
