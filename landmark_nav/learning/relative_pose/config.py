"""Parameters of relative poses."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config


@dataclass(frozen=True)
class RelativePoseConfig(Config):
    """Matching of features between panoramas, and acceptance of a relative pose."""

    # Most features per panorama.
    features: int = 3000
    # Greatest distance of a match in descriptor space, relative to that of the next best.
    max_ratio: float = 0.85
    # Sigma of the direction of a feature, with the errors of the panorama.
    direction_sigma_rad: float = 1.5e-3
    # Sigma of the direction of a feature in a panorama without errors.
    feature_sigma_rad: float = 5e-4
    # Sigma of a sweep's tilt, about x and y.
    tilt_sigma_rad: float = 0.01
    # Prior sigma of the height of a sweep. With a smaller one, a false tilt replaces a height.
    rise_sigma_m: float = 0.02
    # Sigma of the pan zero, which all sweeps share.
    heading_sigma_rad: float = 1e-3
    # Fewest matches that support a relative pose.
    min_matches: int = 20
    # Greatest support of another relative pose, relative to that of the best.
    max_rival: float = 0.8
    # Least distance between two sweeps that give the scale.
    min_baseline_m: float = 0.2
