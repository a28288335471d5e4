"""How the camera is mounted, and how exactly that is known."""

from landmark_nav.calibration.calibration import Calibration, NAMES, scaled, shown, UNITS

__all__ = ['NAMES', 'UNITS', 'Calibration', 'scaled', 'shown']
