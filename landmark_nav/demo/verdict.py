"""Whether the demo went as it should."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from landmark_nav.evaluation.alignment import aligned, aligned_report
from landmark_nav.evaluation.replay import Replay
from landmark_nav.evaluation.run_report import pose_report, run_errors, RunErrors, spells
from landmark_nav.types import LandmarkMap

__all__ = ['Check', 'figures', 'judge']

_MIN_LANDMARKS = 20
_MIN_WALLS = 3
_MAX_RMSE_M = 0.03
_MAX_RMSE_DEG = 0.4
_MIN_AVAILABILITY = 0.95
# Of the scale of a map that is learned without a plan.
_MOST_SIGMAS = 3.0


@dataclass(frozen=True)
class Check:
    """What was asked for, what was measured, and whether that is enough."""

    passed: bool
    text: str


def figures(run: Replay, landmarks: LandmarkMap) -> tuple[dict[str, Any], Replay, RunErrors]:
    """
    Figures of the drive, by the keys of ``landmark-nav evaluate --json``; the run, its errors.

    A map of its own frame has them after alignment; the run is then in the metre of the map.
    """
    walls = len({landmark.wall_id for landmark in landmarks.landmarks} - {''})
    of_run = {'spells': spells(run), 'walls': walls}
    if not landmarks.has_own_frame:
        errors = run_errors(run)
        return pose_report(run, errors, landmarks) | of_run, run, errors
    rigid, (run, errors, alignment) = aligned(run, scaled=False)[1], aligned(run, scaled=True)
    in_frame = aligned_report(rigid, errors, alignment)
    scale_sigma = {'scale_sigma': float(landmarks.provenance['scale_sigma'])}
    return pose_report(run, errors, landmarks) | of_run | in_frame | scale_sigma, run, errors


def judge(measured: dict[str, Any]) -> list[Check]:
    """Hold the figures against what the demo must reach."""
    fused = measured.get('fused_after_scale', measured['fused'])
    odometry = measured['odometry']
    meters, degrees = fused['position_rmse_m'], fused['heading_rmse_deg']
    alone = odometry['position_rmse_m']
    if meters is None or alone is None:
        return [Check(False, 'no fused pose that could be compared with the truth')]
    landmarks, walls = measured['landmarks'], measured['walls']
    available = measured['availability']
    checks = [
        Check(
            landmarks >= _MIN_LANDMARKS and walls >= _MIN_WALLS,
            f'{landmarks} landmarks on {walls} walls (at least {_MIN_LANDMARKS} on {_MIN_WALLS})',
        ),
        Check(
            meters <= _MAX_RMSE_M and degrees <= _MAX_RMSE_DEG,
            f'fused RMSE {100 * meters:.2f} cm and {degrees:.2f} deg '
            f'(at most {100 * _MAX_RMSE_M:g} cm and {_MAX_RMSE_DEG:g} deg)',
        ),
        Check(
            available >= _MIN_AVAILABILITY,
            f'availability {available:.3f} (at least {_MIN_AVAILABILITY:g})',
        ),
        Check(
            meters < alone,
            f'better than odometry alone, which is off by {100 * alone:.1f} cm',
        ),
    ]
    if 'scale' in measured:
        off, most = abs(measured['scale'] - 1.0), _MOST_SIGMAS * measured['scale_sigma']
        checks.append(
            Check(off <= most, f'scale off by {100 * off:.2f} % (at most {100 * most:.2f} %)')
        )
    return checks
