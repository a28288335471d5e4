"""Pose of a sweep, measured from coloured papers."""

from __future__ import annotations

from landmark_nav.learning.reference_area.common_errors import (
    joined,
    joint_covariance,
    pose_errors,
)
from landmark_nav.learning.reference_area.faults import (
    paper_faults,
    PaperFault,
    PaperFaults,
    PaperRecord,
    PaperView,
    view_papers,
)
from landmark_nav.learning.reference_area.location import (
    locate_sweep,
    optical_height,
    PaperSearch,
    SweepPlace,
)
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig
from landmark_nav.learning.reference_area.refusals import MountError, WRONG_PRIOR, WrongMountError
from landmark_nav.learning.reference_area.search import LEAST_PAPERS

__all__ = [
    'LEAST_PAPERS',
    'WRONG_PRIOR',
    'MountError',
    'PaperFault',
    'PaperFaults',
    'PaperRecord',
    'PaperSearch',
    'PaperView',
    'ReferenceAreaConfig',
    'SweepPlace',
    'WrongMountError',
    'joined',
    'joint_covariance',
    'locate_sweep',
    'optical_height',
    'paper_faults',
    'pose_errors',
    'view_papers',
]
