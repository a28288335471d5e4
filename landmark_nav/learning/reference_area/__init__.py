"""Where a sweep was taken, measured from coloured papers."""

from __future__ import annotations

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
    'locate_sweep',
    'optical_height',
]
