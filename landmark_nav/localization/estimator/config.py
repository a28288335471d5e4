"""Noise figures of the estimator."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter

__all__ = ['EstimatorConfig']


@dataclass(frozen=True)
class EstimatorConfig(Config):
    """What varies by how much; the odometry's noise is in `OdometryNoiseConfig`."""

    floor_tilt_sigma_rad: float = parameter(
        0.001,
        'Sigma by which an uneven floor tilts the base, rad.',
        minimum=0.0,
        maximum=0.1,
    )
    floor_tilt_length_m: float = parameter(
        0.5,
        'Way over which the floor changes, m.',
        minimum=0.001,
        maximum=1000.0,
    )
    correlation_length_m: float = parameter(
        10.0,
        'Way over which the error of a landmark changes with the viewpoint, m.',
        minimum=0.1,
        maximum=1e9,
    )
    tail_freedom: float = parameter(
        2.0,
        'Degrees of freedom of the t distribution of detections; 0 has them Gaussian.',
        minimum=0.0,
        maximum=1e6,
    )
    mount_walk_rad_per_sqrt_s: float = parameter(
        2e-5,
        'Sigma by which pan zero, tilt and roll of the camera change in one second, rad.',
        minimum=0.0,
        maximum=0.1,
    )
    step_probability: float = parameter(
        1e-6,
        'Share of the images before which the camera was displaced, the base moved unseen by the '
        'wheels, or the joint delay changed; all are taken to be equally likely.',
        minimum=0.0,
        maximum=0.5,
    )
    step_sigma_rad: float = parameter(
        0.05, 'Sigma of such a turn of camera or base, rad.', minimum=0.0, maximum=1.0
    )
    step_sigma_s: float = parameter(
        0.1, 'Sigma of such a change of the joint delay, s.', minimum=0.0, maximum=10.0
    )
    step_sigma_m: float = parameter(
        0.02, 'Sigma of such a motion of the base, m.', minimum=0.0, maximum=10.0
    )
    history_s: float = parameter(
        2.0, 'How late a measurement may come, s.', minimum=0.0, maximum=60.0
    )
    learning_sigma: float = parameter(
        1.0,
        'How far noise may differ from its parameters: sigma of the logarithm of a factor on its '
        'variance. 0 takes it as it is.',
        minimum=0.0,
        maximum=5.0,
    )
