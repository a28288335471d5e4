"""How the pose is found without a prior, and when it is accepted."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter


@dataclass(frozen=True)
class RelocalizationConfig(Config):
    """
    How the pose is found without a prior, and when it is accepted.

    Chosen by hand; what was compared: docs/decisions.md, localization.
    """

    when_lost: bool = parameter(
        True, 'look for the place without being asked, when it is not known any more'
    )
    search_s: float = parameter(
        15.0, 'how long a call of relocalize may look around', minimum=0.1, maximum=3600.0
    )
    # Seconds in which images show nothing of the map until the place is looked for, too: where
    # nothing is expected, nothing contradicts a wrong pose; s.
    unseen_s: float = 2.0
    # Least landmarks that must support a pose.
    min_landmarks: int = 6
    # Largest predicted position sigma (root of the trace), m.
    max_sigma_m: float = 0.03
    # Largest predicted heading sigma, rad.
    max_sigma_rad: float = 0.008
    # How far tilt and roll of the camera may be off, where nothing is recognised without that; 0
    # does not search for it, and finds a small roll only; rad.
    tilt_sigma_rad: float = 0.02
