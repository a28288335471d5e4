"""Noise figures of the estimator."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, log
from typing import NamedTuple

from landmark_nav.parameters import Config, parameter


class Step(NamedTuple):
    """
    A change between two images that nothing measured.

    `probability` is its share of the images; `sigma_m` and `sigma_rad` are of an unseen motion of
    the base, `calibration` holds sigmas by name.
    """

    probability: float
    sigma_m: float
    sigma_rad: float
    calibration: dict[str, float]

    @property
    def log_odds(self) -> float:
        """Logarithm of the odds."""
        return _log_odds(self.probability)


def _log_odds(probability: float) -> float:
    return log(probability / (1.0 - probability)) if probability else -inf


@dataclass(frozen=True)
class EstimatorConfig(Config):
    """
    Noise of floor, map, mount and detections; that of odometry is in `OdometryNoiseConfig`.

    docs/estimator.md (measured) says which values were chosen on which drives; the others are
    chosen by hand.
    """

    floor_tilt_sigma_rad: float = parameter(
        0.001,
        'sigma by which an uneven floor tilts the base; 0: it is flat',
        minimum=0.0,
        maximum=0.1,
    )
    # Correlation length of the tilt of the floor, m.
    floor_tilt_length_m: float = 0.5
    correlation_length_m: float = parameter(
        10.0,
        'way over which the error of a landmark changes with the viewpoint',
        minimum=0.1,
        maximum=1e9,
    )
    # Degrees of freedom of the t distribution of detections; 0 means Gaussian.
    tail_freedom: float = 2.0
    # Sigma by which pan zero and roll of the camera change in one second, rad.
    mount_walk_rad_per_sqrt_s: float = 2e-5
    # The same for its tilt: joints are loose, and sag.
    tilt_walk_rad_per_sqrt_s: float = 2e-3
    step_probability: float = parameter(
        1e-6,
        'share of the images before which the camera was displaced, the base moved unseen by the '
        'wheels, or the joint delay changed; all are taken to be equally likely',
        minimum=0.0,
        maximum=0.5,
    )
    # Sigma of such a turn of camera or base, rad.
    step_sigma_rad: float = 0.05
    # Sigma of such a motion of the base, m.
    step_sigma_m: float = 0.07
    # Sigma of such a change of the joint delay, s.
    step_sigma_s: float = 0.1
    # Share of the images before which the focal length changed as well, which an unmeasured motion
    # resembles, and the sigma of its scale, 1.
    zoom_probability: float = 1e-7
    step_sigma_focal: float = 0.1
    # Share of the images before which wheels slip or are off otherwise than their noise says, and
    # its sigmas, m and rad.
    slip_probability: float = 1e-3
    slip_sigma_m: float = 0.02
    slip_sigma_rad: float = 0.003
    # Share of the objects of a map that were moved since learning, and the sigma of this, m.
    moved_probability: float = 0.01
    moved_sigma_m: float = 0.1
    # Greatest delay of a measurement, s.
    history_s: float = 2.0
    learning_sigma: float = parameter(
        1.0,
        'sigma of the logarithm of the factors on variances of noise, which are learned; 0: they '
        'stay at 1',
        minimum=0.0,
        maximum=5.0,
    )

    @property
    def moved_log_odds(self) -> float:
        """Log odds that an object was moved since learning."""
        return _log_odds(self.moved_probability)

    @property
    def knock(self) -> Step:
        """What is open after a knock: base and camera may have moved, and the joint delay."""
        turned = dict.fromkeys(('axis_yaw', 'camera_roll', 'camera_tilt'), self.step_sigma_rad)
        calibration = {**turned, 'joint_delay': self.step_sigma_s}
        return Step(self.step_probability, self.step_sigma_m, self.step_sigma_rad, calibration)

    @property
    def zoom(self) -> Step:
        """The same, and the focal length changed."""
        calibration = {**self.knock.calibration, 'focal_scale': self.step_sigma_focal}
        return self.knock._replace(calibration=calibration)

    @property
    def steps(self) -> tuple[tuple[tuple[Step, ...], Step], ...]:
        """
        All that may happen unseen before an image: causes, and what is open after any of them.

        One image does not show which of the causes of a knock it was.
        """
        if not self.step_probability:
            return ()
        slip = Step(self.slip_probability, self.slip_sigma_m, self.slip_sigma_rad, {})
        turned, late = self.knock.calibration, {'joint_delay': self.step_sigma_s}
        turned = {name: sigma for name, sigma in turned.items() if name not in late}
        still = self.knock._replace(sigma_m=0.0, sigma_rad=0.0)
        base = self.knock._replace(calibration={})
        knock = base, still._replace(calibration=turned), still._replace(calibration=late)
        focal = Step(self.zoom_probability, 0.0, 0.0, {'focal_scale': self.step_sigma_focal})
        return ((slip,), slip), (knock, self.knock), ((focal,), self.zoom)
