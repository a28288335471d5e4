"""One estimator of pose, calibration and map errors; see docs/estimator.md."""

from landmark_nav.localization.estimator.config import EstimatorConfig
from landmark_nav.localization.estimator.factors import ImagePoints
from landmark_nav.localization.estimator.filter import JointFilter
from landmark_nav.localization.estimator.integrity import (
    Integrity,
    is_unknown,
    protection_level,
    ProtectionLevel,
    Status,
)
from landmark_nav.localization.estimator.state import Update

__all__ = [
    'EstimatorConfig',
    'ImagePoints',
    'Integrity',
    'JointFilter',
    'ProtectionLevel',
    'Status',
    'Update',
    'is_unknown',
    'protection_level',
]
