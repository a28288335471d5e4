"""A camera that is mounted upside down against robot.yaml: the reference papers show it."""

from __future__ import annotations

from dataclasses import replace
from math import pi

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import wrap_one_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.panorama import PanoramaConfig, synthesize_cylinder
from landmark_nav.learning.reference_area import locate_sweep, ReferenceAreaConfig
from landmark_nav.types import Sweep

__all__ = ['why_upside_down']

# Nobody writes less.
_HARDLY_RAD = 1e-3


def why_upside_down(
    sweep: Sweep, room: Room, mount: PanTiltMount, config: ReferenceAreaConfig
) -> str | None:
    """What to change in ``robot.yaml`` if the papers fit upside down; None if they don't."""
    roll, pitch, yaw = mount.axis_rpy
    for what, remedy, other in (
        (
            'camera',
            f'camera_roll: {_turned(mount.camera_roll_rad)}',
            replace(mount, camera_roll_rad=mount.camera_roll_rad + pi),
        ),
        (
            'pan unit',
            f'pan_axis rpy: [{_turned(roll)}, {pitch:.4f}, {yaw:.4f}]',
            replace(mount, axis_rpy=(roll + pi, pitch, yaw)),
        ),
    ):
        view = synthesize_cylinder(sweep, other, PanoramaConfig(blend='feather'))
        try:
            locate_sweep(sweep, view, room, other, config)
        except LandmarkNavError:
            continue
        return f'the {what} is mounted the other way up, as the papers show it: set {remedy}'
    return None


def _turned(angle_rad: float) -> str:
    """Angle and half a turn, as one writes it."""
    angle_rad = wrap_one_rad(angle_rad + pi)
    return '0' if abs(angle_rad) < _HARDLY_RAD else f'{angle_rad:.4f}'
