"""The best line of a whole recording."""

from __future__ import annotations

from landmark_nav.localization.smoother.smoothing import (
    smooth,
    Smoothed,
)

__all__ = ['Smoothed', 'smooth']
