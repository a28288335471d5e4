"""Self-calibration of camera and mount from overlapping frames of a sweep."""

from __future__ import annotations

from landmark_nav.learning.calibration.sweep_calibration import (
    align_sweep,
    calibrate_sweep,
    moved_px,
    SweepCalibration,
)
from landmark_nav.learning.calibration.turn import check_turn, measure_turn, SweepTurn

__all__ = [
    'SweepCalibration',
    'SweepTurn',
    'align_sweep',
    'calibrate_sweep',
    'check_turn',
    'measure_turn',
    'moved_px',
]
