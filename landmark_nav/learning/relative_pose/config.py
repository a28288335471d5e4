"""Parameters of relative poses."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config


@dataclass(frozen=True)
class RelativePoseConfig(Config):
    """What is matched between two panoramas, and when their relative pose counts as found."""

    # Features per panorama at most.
    features: int = 3000
    # Greatest distance of a match in descriptor space, as a share of that of the next best.
    max_ratio: float = 0.85
    # Standard deviation of the direction of a feature.
    direction_sigma_rad: float = 1.5e-3
    # The same of a feature alone, in a panorama that has no errors.
    feature_sigma_rad: float = 5e-4
    # Standard deviation of a sweep's tilt, about x and y.
    tilt_sigma_rad: float = 0.01
    # Standard deviation of the height of a sweep, before panoramas show it: too little is made up
    # for by a tilt that is none.
    rise_sigma_m: float = 0.02
    # Standard deviation of where the camera points at pan 0, which all sweeps share.
    heading_sigma_rad: float = 1e-3
    # Least matches that agree on a relative pose.
    min_matches: int = 20
    # Greatest support of another relative pose, as a share of that of the best.
    max_rival: float = 0.8
    # Least distance between two sweeps that scale is taken from.
    min_baseline_m: float = 0.2
