"""Noise figures of the estimator."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter


@dataclass(frozen=True)
class EstimatorConfig(Config):
    """
    What varies by how much; the odometry's noise is in `OdometryNoiseConfig`.

    What was chosen on which drives: docs/estimator.md, measured. The others are chosen by hand.
    """

    floor_tilt_sigma_rad: float = parameter(
        0.001,
        'sigma by which an uneven floor tilts the base; 0: it is flat',
        minimum=0.0,
        maximum=0.1,
    )
    # Way over which the floor changes, m.
    floor_tilt_length_m: float = 0.5
    correlation_length_m: float = parameter(
        10.0,
        'way over which the error of a landmark changes with the viewpoint',
        minimum=0.1,
        maximum=1e9,
    )
    # Degrees of freedom of the t distribution of detections; 0 has them Gaussian.
    tail_freedom: float = 2.0
    # Sigma by which pan zero, tilt and roll of the camera change in one second, rad.
    mount_walk_rad_per_sqrt_s: float = 2e-5
    step_probability: float = parameter(
        1e-6,
        'share of the images before which the camera was displaced, the base moved unseen by the '
        'wheels, or the joint delay changed; all are taken to be equally likely',
        minimum=0.0,
        maximum=0.5,
    )
    # Sigma of such a turn of camera or base, rad.
    step_sigma_rad: float = 0.05
    # Sigma of such a change of the joint delay, s.
    step_sigma_s: float = 0.1
    # Sigma of such a change of the focal length, 1.
    step_sigma_focal: float = 0.1
    # Sigma of such a motion of the base, m.
    step_sigma_m: float = 0.1
    # How late a measurement may come, s.
    history_s: float = 2.0
    learning_sigma: float = parameter(
        1.0,
        'how far noise may differ from what is expected: sigma of the logarithm of a factor on '
        'its variance; 0: not at all',
        minimum=0.0,
        maximum=5.0,
    )

    @property
    def knock(self) -> dict[str, float]:
        """Sigmas by which values of the mount and its joints may change at once, by name."""
        turns = dict.fromkeys(('axis_yaw', 'camera_roll', 'camera_tilt'), self.step_sigma_rad)
        return turns | {'joint_delay': self.step_sigma_s}

    @property
    def steps(self) -> dict[str, float]:
        """The same with the lens: only images show its change, which a pose does not hide."""
        return self.knock | {'focal_scale': self.step_sigma_focal}
