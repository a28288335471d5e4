"""Whether the demo went as it should."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from landmark_nav.evaluation.replay import Replay
from landmark_nav.evaluation.run_report import pose_report, run_errors, spells
from landmark_nav.types import LandmarkMap

__all__ = ['Check', 'figures', 'judge']

_MIN_LANDMARKS = 20
_MIN_WALLS = 3
_MAX_RMSE_M = 0.03
_MAX_RMSE_DEG = 0.4
_MIN_AVAILABILITY = 0.95


@dataclass(frozen=True)
class Check:
    """What was asked for, what was measured, and whether that is enough."""

    passed: bool
    text: str


def figures(run: Replay, landmarks: LandmarkMap) -> dict[str, Any]:
    """Figures of the drive, by the keys of ``landmark-nav evaluate --json``."""
    walls = len({landmark.wall_id for landmark in landmarks.landmarks})
    return {**pose_report(run, run_errors(run), landmarks), 'spells': spells(run), 'walls': walls}


def judge(measured: dict[str, Any]) -> list[Check]:
    """Hold the figures against what the demo must reach."""
    fused, odometry = measured['fused'], measured['odometry']
    meters, degrees = fused['position_rmse_m'], fused['heading_rmse_deg']
    alone = odometry['position_rmse_m']
    if meters is None or alone is None:
        return [Check(False, 'no fused pose that could be compared with the truth')]
    landmarks, walls = measured['landmarks'], measured['walls']
    available = measured['availability']
    return [
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
