"""
The stages of learning.

`sweep_pipeline` makes a panorama of each sweep. The stages here are
panoramas -> candidates -> wall patches -> measurements -> adjustment -> election -> map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import logging

import numpy as np
from scipy.special import chdtri

from landmark_nav.calibration import Calibration, NAMES
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment.depth_from_scale import depth_from_scale
from landmark_nav.learning.adjustment.problem import AdjustmentConfig, CALIBRATED
from landmark_nav.learning.adjustment.solution import adjust, Adjustment
from landmark_nav.learning.adjustment.wall_fit import (
    check_walls,
    moved_walls,
    wall_residuals,
    wall_warnings,
    WallResidual,
)
from landmark_nav.learning.attention.maps import AttentionConfig
from landmark_nav.learning.attention.selection import attend
from landmark_nav.learning.calibration.overlap_fit import CORRECTED
from landmark_nav.learning.election import elect, ElectionConfig
from landmark_nav.learning.least_squares import checked_covariance, covariance_of, solve_positive
from landmark_nav.learning.reference_area.common_errors import joint_covariance
from landmark_nav.learning.reference_area.model import MEASURED
from landmark_nav.learning.stages import StageLog
from landmark_nav.learning.stereo.reconstruction import reconstruct
from landmark_nav.learning.stereo.wall_patch import StereoConfig, Ties
from landmark_nav.parameters import Config
from landmark_nav.types import Candidate, FloatArray, Landmark, LandmarkMap, Panorama, Refusal

_LOG = logging.getLogger(__name__)

# Greatest sigmas of the pose of a panorama: x, y, height (m) and heading (rad).
_MOST_SIGMA = np.array([1.0, 1.0, 1.0, 0.3])
# Greatest number of landmarks that is reported as too few: three make only one triplet, which is
# not in view from everywhere.
_FEW = 3
# Sigma of the distance of a patch from its wall for an adjustment by stereo alone.
_NO_WALL_M = 1.0
# Probability of a misfit of panoramas by chance with which their calibrations are consistent.
_CHANCE = 1e-3
# Weight of the expected sigmas at which they are not estimated.
_AS_EXPECTED = 1e9


@dataclass(frozen=True)
class LearningConfig(Config):
    """Parameters of the stages from panoramas to the map."""

    attention: AttentionConfig = field(default_factory=AttentionConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    election: ElectionConfig = field(default_factory=ElectionConfig)


@dataclass(frozen=True, eq=False)
class LearningResult:
    """
    The learned map, and the outcome of every candidate.

    `panoramas` have adjusted poses. `candidates` and `outcomes` have one tuple for each panorama,
    in the same order; an outcome is the elected `Landmark` or the reason against it. `ambiguous`
    holds, for each panorama, the reasons why attention refused other patches. `reconstructed` is
    the number of candidates found in other panoramas. `walls` holds the distances of patches from
    each wall that has enough of them, and `warning` describes walls that may be wrong.
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

    Raises `LandmarkNavError`: there is only one panorama, all are from one place, walls do not fit
    the measurements, or no landmark is elected.

    Parameters
    ----------
    panoramas : sequence of Panorama
        Panoramas from v places.
    places : ndarray, shape (4 v, 4 v), optional
        Prior joint covariance of the viewpoints; by default that of poses measured by papers, or
        of independently given poses.
    ties : Ties, optional
        Features common to several panoramas.
    """
    _check(panoramas)
    panoramas = consistent(panoramas)
    log = log or StageLog()
    with log.measure('attention'):
        attended = [attend(p, config.attention) for p in panoramas]
        candidates = tuple(a.candidates for a in attended)

    joint = joint_covariance(panoramas, room) if places is None else places

    without_walls = replace(
        config.adjustment,
        relief_sigma_m=_NO_WALL_M,
        camera_weight=_AS_EXPECTED,
        place_weight=_AS_EXPECTED,
        room_weight=_AS_EXPECTED,
    )

    def adjusted_by(expected: AdjustmentConfig) -> Adjustment:
        start = np.array([patch.position for patch in found.patches])
        seen, walls, normals = found.measurements, found.walls, found.normals
        return adjust(seen, walls, start, panoramas, joint, room, expected, normals, ties)

    how = config.stereo, ties, config.election.max_overlap
    with log.measure('stereo'):
        found = reconstruct(panoramas, candidates, room, *how)
        if any(wall.sigma_m for wall in room.walls) and found.patches:
            free = adjusted_by(without_walls)
            room, shift_m = moved_walls(free, found.walls, room, config.adjustment)
            if shift_m > config.adjustment.hanging_sigma_m:
                found = reconstruct(panoramas, candidates, room, *how)
    outcomes = found.outcomes
    if len(found.patches) < 3:
        raise LandmarkNavError(
            f'{len(found.patches)} of {sum(map(len, candidates))} candidates were found again '
            f'from another place ({_reasons(outcomes)}): take panoramas 1 to 3 m apart that see '
            'the same textured walls, and check room.yaml'
        )
    with log.measure('adjustment'):
        free = adjusted_by(without_walls)
        hidden = ''
        if ties is None:  # with ties, walls are estimated, so that there are none to check
            behind = [patch.wall for patch in found.patches]
            hidden = check_walls(free, behind, room, config.adjustment)
        adjustment = adjusted_by(config.adjustment)
        residuals = wall_residuals(adjustment, found.walls, room, config.adjustment)
        adjustment, free = depth_from_scale(
            adjustment, free, found.measurements, found.normals, config.adjustment,
            config.election.max_depth_sigma_m,
        )  # fmt: skip
    uneven = wall_warnings(residuals, adjustment.hanging_sigma_m, config.adjustment)
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
            found.patches, found.measurements, adjustment, free, adjusted, room, config.election
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


def _calibration(
    panoramas: Sequence[Panorama], adjustment: Adjustment, config: LearningConfig
) -> Calibration | None:
    """Calibration after the last panorama, updated by the adjustment of all panoramas."""
    known = panoramas[-1].calibration
    if known is None or not len(adjustment.calibration):
        return known
    which = [NAMES.index(name) for name in CALIBRATED]
    before = known.covariance[np.ix_(which, which)]
    # What the adjustment does not estimate follows by its correlation.
    gain = known.covariance[:, which] @ np.linalg.pinv(before, hermitian=True)
    gain[which] = np.eye(len(which))
    values = known.values + gain @ (adjustment.calibration - known.values[which])
    covariance = known.covariance + gain @ (adjustment.calibration_covariance - before) @ gain.T
    covariance = 0.5 * (covariance + covariance.T)
    if not config.adjustment.tilt_sigma_rad:
        # The tilt of the floor at the panoramas is not part of the mount: its variance is added.
        axis_tilt = [NAMES.index(name) for name in ('axis_roll', 'axis_pitch')]
        floor = MEASURED.horizon_sigma_rad**2 / len(panoramas)
        covariance[axis_tilt, axis_tilt] += floor
    by_map = gain @ adjustment.calibration_loading
    return replace(known, values=values, covariance=covariance, by_map=by_map)


def consistent(panoramas: Sequence[Panorama]) -> list[Panorama]:
    """
    Inflate the covariances of what panoramas show of their camera if they contradict each other.

    All have one lens and one optical centre, so that values farther apart than by chance show
    errors that no covariance contains: all covariances grow by the mean square of the misfit, as
    is usual for inconsistent measurements (Birge, Physical Review 40, 1932).
    """
    known = [p.calibration for p in panoramas if p.calibration is not None]
    if len(known) < 2 or not all(known[0].same_camera(k) for k in known):
        return list(panoramas)
    shown = np.array(CORRECTED)[np.all([k.sigmas[CORRECTED] > 0.0 for k in known], axis=0)]
    values = np.array([k.values[shown] for k in known])
    information = np.array([covariance_of(k.covariance[np.ix_(shown, shown)]) for k in known])
    score = np.einsum('kij,kj->i', information, values)
    off = values - solve_positive(information.sum(0), score)
    misfit = float(np.einsum('ki,kij,kj->', off, information, off))
    freedom = max((len(known) - 1) * len(shown), 1)
    if misfit <= chdtri(freedom, _CHANCE):
        return list(panoramas)
    factor = np.ones(len(NAMES))
    factor[shown] = np.sqrt(misfit / freedom)

    def inflated(panorama: Panorama) -> Panorama:
        if (one := panorama.calibration) is None:
            return panorama
        covariance = one.covariance * np.outer(factor, factor)
        return replace(panorama, calibration=replace(one, covariance=covariance))

    return [inflated(panorama) for panorama in panoramas]


def _check(panoramas: Sequence[Panorama]) -> None:
    check_number(panoramas)
    for p in panoramas:
        if not np.isfinite([*p.center_map, p.heading_rad]).all():
            raise LandmarkNavError('panorama/pose is not a number: fix its publisher')
        checked_covariance(p.covariance, _MOST_SIGMA, 'panorama/pose')
    centers = np.array([p.center_map[:2] for p in panoramas])
    spread = float(np.max(np.linalg.norm(centers[:, None] - centers[None], axis=-1)))
    if spread < 0.2:
        raise LandmarkNavError(
            f'all {len(panoramas)} panoramas are from one place (within {spread:.2f} m): '
            'take another sweep 1 to 3 m away'
        )


def _reasons(outcomes: Sequence[Sequence[Landmark | Refusal]]) -> str:
    """Numbers of the reasons of refusals, the most frequent first."""
    reasons = [o.reason for group in outcomes for o in group if isinstance(o, Refusal)]
    ranked = sorted(set(reasons), key=lambda r: -reasons.count(r))
    return ', '.join(f'{reasons.count(r)} {r}' for r in ranked)


def check_number(panoramas: Sequence[Panorama]) -> None:
    """Raise `LandmarkNavError` if there are fewer than two panoramas."""
    if len(panoramas) < 2:
        raise LandmarkNavError(
            f'learning needs two panoramas from different places, not {len(panoramas)}: '
            'take another sweep 1 to 3 m away'
        )
