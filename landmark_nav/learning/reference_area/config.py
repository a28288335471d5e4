"""What is not exactly known when a place is measured from papers."""

from __future__ import annotations

from dataclasses import dataclass

from landmark_nav.parameters import Config


@dataclass(frozen=True)
class ReferenceAreaConfig(Config):
    """
    Standard deviations of what is given of papers, camera and joints.

    Chosen by hand; what differs more is found and named.
    """

    # Standard deviation of how exactly a paper hangs, metres.
    paper_sigma_m: float = 0.001
    # Standard deviation of the camera's height, metres.
    height_sigma_m: float = 0.005
    # Standard deviation of the pan axis' tilt, radians.
    horizon_sigma_rad: float = 0.003
    # Standard deviation that all points of one edge share, pixels.
    edge_sigma_px: float = 0.05
    # Standard deviation of the size of papers, a share.
    paper_size_sigma: float = 0.002
