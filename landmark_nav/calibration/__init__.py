"""How the camera is mounted, and how exactly that is known."""

from landmark_nav.calibration.calibration import (
    Calibration,
    NAMES,
    scaled,
    shown,
    SHOWN_IN,
    UNITS,
)

__all__ = ['NAMES', 'SHOWN_IN', 'UNITS', 'Calibration', 'scaled', 'shown']
