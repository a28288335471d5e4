"""
Entry points of the executables: each heeds signals first, then imports what it runs.

Imports take a second, in which Python's own handlers print a traceback.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

from landmark_nav.signals import end_at_once

__all__ = [
    'bag_player',
    'command',
    'landmark_learner',
    'odometry_fusion',
    'panorama_synthesizer',
    'room_simulator',
    'sweep_capture',
    'triangulation_localizer',
    'triplet_selector',
]


def command() -> int:
    """`landmark-nav`."""
    end_at_once()
    return int(import_module('landmark_nav.cli.main').main())


def _node(name: str) -> Callable[[], int]:
    def run() -> int:
        end_at_once(0)
        return int(import_module(f'landmark_nav.nodes.{name}').main())

    return run


bag_player = _node('bag_player')
landmark_learner = _node('landmark_learner')
odometry_fusion = _node('odometry_fusion')
panorama_synthesizer = _node('panorama_synthesizer')
room_simulator = _node('room_simulator')
sweep_capture = _node('sweep_capture')
triangulation_localizer = _node('triangulation_localizer')
triplet_selector = _node('triplet_selector')
