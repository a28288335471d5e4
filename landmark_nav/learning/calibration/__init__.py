"""Camera and mount, out of what neighbouring frames of a sweep both show."""

from __future__ import annotations

from landmark_nav.learning.calibration.sweep_calibration import (
    calibrate_sweep,
    CalibrationConfig,
    fit_significant,
    moved_px,
    SweepCalibration,
)

__all__ = [
    'CalibrationConfig',
    'SweepCalibration',
    'calibrate_sweep',
    'fit_significant',
    'moved_px',
]
