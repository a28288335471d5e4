"""Where the camera should be, and how well that is known: what a search for landmarks needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np

from landmark_nav.calibration.calibration import Calibration
from landmark_nav.types import PoseEstimate

__all__ = ['Expectation']


@dataclass(frozen=True, eq=False)
class Expectation(PoseEstimate):
    """
    Pose of the base at a time, and the calibration.

    The covariance is that of the pan axis in the direction of the camera: errors of heading and
    pan zero that cancel are left out.

    Parameters
    ----------
    calibration : Calibration
        Its standard deviations count, not its correlations.
    tilt_sigma_rad : float
        How well it is known how high the camera looks: of base, axis and camera together.

    """

    calibration: Calibration
    tilt_sigma_rad: float

    def pan_sigma_rad(self, pan_rate_rad_s: float) -> float:
        """How well the pan is known at this rate, beside the pan zero."""
        delay = abs(pan_rate_rad_s) * self.calibration['joint_delay'][1]
        return math.hypot(delay, self.calibration.base.pan_sigma_rad)

    def stepped(self, sigma_m: float, sigma_rad: float, sigma_s: float) -> Expectation:
        """
        Return what is expected if base, camera or joint delay have changed by so much.

        What is exact stays.
        """
        known = self.calibration
        steps = {'camera_roll': sigma_rad, 'camera_tilt': sigma_rad, 'axis_yaw': sigma_rad}
        steps['joint_delay'] = sigma_s
        steps = {name: step for name, step in steps.items() if known[name][1] > 0.0}
        turns = 1.0 + ('axis_yaw' in steps)
        return replace(
            self,
            covariance=self.covariance + np.diag([sigma_m**2, sigma_m**2, turns * sigma_rad**2]),
            calibration=known.widened(steps),
            tilt_sigma_rad=math.hypot(self.tilt_sigma_rad, steps.get('camera_tilt', 0.0)),
        )
