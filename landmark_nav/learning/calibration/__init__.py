"""Self-calibration of camera and mount from overlapping frames of a sweep."""

from __future__ import annotations

from landmark_nav.learning.calibration.sweep_calibration import (
    calibrate_sweep,
    CalibrationConfig,
    fit_significant,
    moved_px,
    SweepCalibration,
)
from landmark_nav.learning.calibration.turn import check_turn, measure_turn, SweepTurn

__all__ = [
    'CalibrationConfig',
    'SweepCalibration',
    'SweepTurn',
    'calibrate_sweep',
    'check_turn',
    'fit_significant',
    'measure_turn',
    'moved_px',
]
