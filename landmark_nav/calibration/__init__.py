"""Calibration of a robot: mount, lens and clocks, with their covariance."""

from landmark_nav.calibration.calibration import (
    Calibration,
    DEFAULT_SIGMAS,
    LENS,
    MEANINGS,
    NAMES,
    shown,
    SHOWN_IN,
    UNITS,
)
