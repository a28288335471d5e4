"""Sheets of a known size at unknown places: papers of a hue and markers with a number."""

from __future__ import annotations

from landmark_nav.learning.sheets.config import SheetsConfig
from landmark_nav.learning.sheets.papers import find_markers, find_papers, SheetView
from landmark_nav.types import Panorama

__all__ = ['SheetView', 'SheetsConfig', 'find_sheets']


def find_sheets(panorama: Panorama, config: SheetsConfig) -> list[SheetView]:
    """Find candidates for sheets of a known size in a panorama; its pose is not used."""
    found: list[SheetView] = []
    if config.has_papers:
        found += find_papers(panorama, config)
    if config.has_markers:
        found += find_markers(panorama, config)
    return found
