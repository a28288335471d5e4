"""How the camera is mounted, and how exactly that is known."""

from landmark_nav.calibration.calibration import Calibration, NAMES, UNITS
from landmark_nav.calibration.expectation import Expectation

__all__ = ['NAMES', 'UNITS', 'Calibration', 'Expectation']
