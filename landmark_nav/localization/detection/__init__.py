"""Landmarks found in an image: what to expect, how it looks, where it is."""

from __future__ import annotations

from landmark_nav.localization.detection.correlation import detect_landmarks, DetectionResult
from landmark_nav.localization.detection.expectation import DetectionConfig, View

__all__ = ['DetectionConfig', 'DetectionResult', 'View', 'detect_landmarks']
