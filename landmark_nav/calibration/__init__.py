"""How the camera is mounted, and how exactly that is known."""

from landmark_nav.calibration.calibration import (
    Calibration,
    MEANINGS,
    NAMES,
    scaled,
    shown,
    SHOWN_IN,
    UNITS,
)

__all__ = ['MEANINGS', 'NAMES', 'SHOWN_IN', 'UNITS', 'Calibration', 'scaled', 'shown']
