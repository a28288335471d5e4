"""Where a sweep was taken, measured from coloured papers."""

from __future__ import annotations

from landmark_nav.learning.reference_area.common_errors import (
    joined,
    joint_covariance,
    pose_errors,
)
from landmark_nav.learning.reference_area.config import ReferenceAreaConfig
from landmark_nav.learning.reference_area.location import (
    check_agreement,
    LEAST_PAPERS,
    locate_sweep,
    optical_height,
    SweepPlace,
)

__all__ = [
    'LEAST_PAPERS',
    'ReferenceAreaConfig',
    'SweepPlace',
    'check_agreement',
    'joined',
    'joint_covariance',
    'locate_sweep',
    'optical_height',
    'pose_errors',
]
