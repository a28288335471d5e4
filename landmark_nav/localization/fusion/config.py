"""Parameters of the filter."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter

__all__ = ['FusionConfig', 'HealthConfig']


@dataclass(frozen=True)
class FusionConfig(Config):
    """What the filter takes and how strictly."""

    mode: str = parameter(
        'bearings',
        'What corrects the odometry: every bearing by itself, or triangulated poses.',
        choices=('bearings', 'poses'),
    )
    landmarks: str = parameter(
        'refine',
        'Landmark errors: carried along; or what each has of its own refined where nothing is in '
        'doubt; or what all share estimated as well.',
        choices=('consider', 'refine', 'estimate'),
    )
    correlation_length_m: float = parameter(
        3.0,
        'Way over which it is forgotten what was seen of single landmarks, m.',
        minimum=0.1,
        maximum=1e9,
        formerly='map_memory_m',
    )
    bearing_probability: float = parameter(
        0.999, 'Chi-square level of the gates for bearings.', minimum=0.5, maximum=1.0
    )
    correlated_noise_fraction: float = parameter(
        0.35,
        "Share of a detection's variance that those of the same landmark repeat until the robot "
        'has moved on.',
        minimum=0.0,
        maximum=1.0,
        formerly='repeated_share',
    )
    repeat_length_m: float = parameter(
        0.5, 'Way over which they cease to, m.', minimum=0.001, maximum=1000.0
    )
    boresight_sigma_rad: float = parameter(
        0.0,
        'Sigma of a constant offset of all bearings that is estimated; 0 takes it as known.',
        minimum=0.0,
        maximum=1.0,
    )
    principal_point_sigma: float = parameter(
        0.0,
        'Sigma of an error of the principal point, over the focal length, that is estimated; 0 '
        'takes it as calibrated.',
        minimum=0.0,
        maximum=1.0,
    )
    delay_sigma_s: float = parameter(
        0.0,
        'Sigma of a constant delay of the stamps of the joints behind those of the images, that '
        'is estimated where the rate of the pan is known; 0 takes it as none, s.',
        minimum=0.0,
        maximum=1.0,
    )
    nonlinearity_inflation: float = parameter(
        10.0,
        'How many images in a row repeat what linearising bearings leaves out, where the pose '
        'is known to decimetres only; 0 takes bearings as linear.',
        minimum=0.0,
        maximum=1000.0,
        formerly='curvature_repeats',
    )
    turn_sigma_rad: float = parameter(
        0.035,
        'How far heading and boresight are doubted at most where all bearings are off by one '
        'angle; 0 has it contradict the pose.',
        minimum=0.0,
        maximum=1.0,
    )
    history_s: float = parameter(
        2.0, 'How late a measurement may come, s.', minimum=0.0, maximum=60.0
    )


@dataclass(frozen=True)
class HealthConfig(Config):
    """When the filter calls itself coasting or lost."""

    coasting_after_s: float = parameter(
        1.0, 'Seconds without an accepted measurement until coasting.', minimum=0.0, maximum=3600.0
    )
    silent_after_s: float = parameter(
        0.7, 'Seconds without odometry until coasting.', minimum=0.0, maximum=3600.0
    )
    lost_after_rejections: int = parameter(
        5,
        'Measurements that contradict the pose, with none used between them, until lost.',
        minimum=1,
        maximum=1000,
    )
    lost_sigma_m: float = parameter(
        1.0, 'Position sigma (root of the trace) above which the filter is lost, m.', minimum=0.0
    )
    lost_sigma_rad: float = parameter(
        0.5, 'Heading sigma above which the filter is lost, rad.', minimum=0.0
    )
