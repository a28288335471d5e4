"""Capture of a sweep: for each step, turn the camera, let it settle and keep one good frame."""

from __future__ import annotations

from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.learning.capture.frames import KeptFrame, Shot
from landmark_nav.learning.capture.sweep import (
    begin_or_resume,
    describe_progress,
    describe_sweep,
    SweepCapture,
)

__all__ = [
    'CaptureConfig',
    'KeptFrame',
    'Shot',
    'SweepCapture',
    'begin_or_resume',
    'describe_progress',
    'describe_sweep',
]
