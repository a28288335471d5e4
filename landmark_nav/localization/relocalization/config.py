"""How the pose is found without a prior, and when it is accepted."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter


@dataclass(frozen=True)
class RelocalizationConfig(Config):
    """
    How the pose is found without a prior, and when it is accepted.

    The values are chosen by hand; docs/decisions.md (localization) has comparisons.
    """

    when_lost: bool = parameter(True, 'relocalize automatically while the pose is lost')
    search_s: float = parameter(
        15.0, 'how long a call of relocalize may look around', minimum=0.1, maximum=3600.0
    )
    # Time without any landmark in the images after which the robot also relocalizes, s: where no
    # landmark is expected, nothing contradicts a wrong pose.
    unseen_s: float = 2.0
    # Fewest landmarks that must support a pose.
    min_landmarks: int = 6
    # Largest predicted position sigma (root of the trace), m.
    max_sigma_m: float = 0.03
    # Largest predicted heading sigma, rad.
    max_sigma_rad: float = 0.008
    # Sigma of tilt and roll in a second search, if the first recognises nothing, rad; 0 disables
    # it, so that only a small roll is found.
    tilt_sigma_rad: float = 0.02
