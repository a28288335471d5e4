"""How the pose is found without a prior, and when it is accepted."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter

__all__ = ['RelocalizationConfig']


@dataclass(frozen=True)
class RelocalizationConfig(Config):
    """How the pose is found without a prior, and when it is accepted."""

    when_lost: bool = parameter(
        True, 'look for the place without being asked, when it is not known any more'
    )
    unseen_s: float = parameter(
        2.0,
        'seconds in which images show nothing of the map until the place is looked for, too: '
        'where nothing is expected, nothing contradicts a wrong pose; s',
        minimum=0.0,
        maximum=3600.0,
    )
    min_landmarks: int = parameter(
        6, 'least landmarks that must support a pose', minimum=4, maximum=1000
    )
    max_sigma_m: float = parameter(
        0.03, 'largest predicted position sigma (root of the trace), m', minimum=0.0, maximum=10.0
    )
    max_sigma_rad: float = parameter(
        0.008, 'largest predicted heading sigma, rad', minimum=0.0, maximum=3.0
    )
    tilt_sigma_rad: float = parameter(
        0.02,
        'how far tilt and roll of the camera may be off, where nothing '
        'is recognised without that; 0 does not search for it, and finds a small roll only; rad',
        minimum=0.0,
        maximum=0.1,
        formerly='lean_sigma_rad',
    )
