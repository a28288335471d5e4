"""What is not exactly known when a place is measured from papers."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config, parameter

__all__ = ['ReferenceAreaConfig']


@dataclass(frozen=True)
class ReferenceAreaConfig(Config):
    """Standard deviations of what is given of papers, camera and joints."""

    paper_sigma_m: float = parameter(
        0.001, 'standard deviation of how exactly a paper hangs, metres', minimum=0, maximum=0.1
    )
    height_sigma_m: float = parameter(
        0.005, "standard deviation of the camera's height, metres", minimum=1e-5, maximum=0.5
    )
    horizon_sigma_rad: float = parameter(
        0.003, "standard deviation of the pan axis' tilt, radians", minimum=1e-6, maximum=0.2
    )
    edge_sigma_px: float = parameter(
        0.05, 'standard deviation that all points of one edge share, pixels', minimum=0, maximum=2
    )
    paper_size_sigma: float = parameter(
        0.002, 'standard deviation of the size of papers, a share', minimum=1e-5, maximum=0.1
    )
