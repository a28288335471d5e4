"""How the camera is mounted, and how exactly that is known."""

from landmark_nav.calibration.calibration import (
    Calibration,
    MEANINGS,
    NAMES,
    scaled,
    shown,
    UNITS,
)

__all__ = ['MEANINGS', 'NAMES', 'UNITS', 'Calibration', 'scaled', 'shown']
