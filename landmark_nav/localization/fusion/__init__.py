"""Bearings, or triangulated poses, and odometry in one filter."""

from __future__ import annotations

from landmark_nav.localization.fusion.pose_filter import (
    FusionConfig,
    FusionUpdate,
    PoseFilter,
)

__all__ = ['FusionConfig', 'FusionUpdate', 'PoseFilter']
