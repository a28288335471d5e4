"""Taking a sweep: turn the camera step by step, let it settle, keep one good frame, go on."""

from __future__ import annotations

from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.learning.capture.frames import KeptFrame, Shot
from landmark_nav.learning.capture.resume import begin_or_resume, describe_progress, describe_sweep
from landmark_nav.learning.capture.sweep import SweepCapture

__all__ = [
    'CaptureConfig',
    'KeptFrame',
    'Shot',
    'SweepCapture',
    'begin_or_resume',
    'describe_progress',
    'describe_sweep',
]
