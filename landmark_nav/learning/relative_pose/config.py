"""Parameters of relative poses."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter

__all__ = ['RelativePoseConfig']


@dataclass(frozen=True)
class RelativePoseConfig(Config):
    """What is matched between two panoramas, and when their relative pose counts as found."""

    features: int = parameter(3000, 'features per panorama at most', minimum=100, maximum=20000)
    max_ratio: float = parameter(
        0.85,
        'greatest distance of a match in descriptor space, as a share of that of the next best',
        minimum=0.1,
        maximum=1,
    )
    direction_sigma_rad: float = parameter(
        1.5e-3, 'standard deviation of the direction of a feature', minimum=1e-5, maximum=0.1
    )
    feature_sigma_rad: float = parameter(
        5e-4,
        'the same of a feature alone, in a panorama that has no errors',
        minimum=1e-5,
        maximum=0.1,
    )
    tilt_sigma_rad: float = parameter(
        0.01, "standard deviation of a sweep's tilt, about x and y", minimum=1e-6, maximum=0.2
    )
    rise_sigma_m: float = parameter(
        0.003, 'standard deviation of the height of a sweep', minimum=1e-5, maximum=0.5
    )
    heading_sigma_rad: float = parameter(
        1e-3,
        'standard deviation of where the camera points at pan 0, which all sweeps share',
        minimum=0,
        maximum=0.2,
    )
    min_matches: int = parameter(
        20, 'least matches that agree on a relative pose', minimum=8, maximum=10000
    )
    max_rival: float = parameter(
        0.8,
        'greatest support of another relative pose, as a share of that of the best',
        minimum=0,
        maximum=1,
    )
    min_baseline_m: float = parameter(
        0.2, 'least distance between two sweeps that scale is taken from', minimum=0.01
    )
