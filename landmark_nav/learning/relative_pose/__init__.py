"""Relative poses of sweeps, from features that their panoramas share."""

from __future__ import annotations

from landmark_nav.learning.relative_pose.epipolar import RelativePoseConfig
from landmark_nav.learning.relative_pose.features import Features, find_features
from landmark_nav.learning.relative_pose.poses import relative_poses, RelativePoses

__all__ = [
    'Features',
    'RelativePoseConfig',
    'RelativePoses',
    'find_features',
    'relative_poses',
]
