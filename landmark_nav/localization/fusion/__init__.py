"""Bearings, or triangulated poses, and odometry in one filter."""

from __future__ import annotations

from landmark_nav.localization.fusion.config import FusionConfig
from landmark_nav.localization.fusion.pose_filter import PoseFilter
from landmark_nav.localization.fusion.update import FusionUpdate

__all__ = ['FusionConfig', 'FusionUpdate', 'PoseFilter']
