"""A camera that hangs upside down though nobody said so: the reference papers show it."""

from __future__ import annotations

from dataclasses import replace
from math import pi

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.panorama import PanoramaConfig, synthesize_cylinder
from landmark_nav.learning.reference_area import locate_sweep, ReferenceAreaConfig
from landmark_nav.types import Sweep

__all__ = ['why_overturned']


def why_overturned(
    sweep: Sweep, room: Room, mount: PanTiltMount, config: ReferenceAreaConfig
) -> str | None:
    """What to change in ``robot.yaml`` if the papers fit upside down; None if they don't."""
    roll, pitch, yaw = mount.axis_rpy
    for what, remedy, other in (
        (
            'camera',
            f'camera_roll: {mount.camera_roll_rad + pi:.4f}',
            replace(mount, camera_roll_rad=mount.camera_roll_rad + pi),
        ),
        (
            'pan unit',
            f'pan_axis rpy: [{roll + pi:.4f}, {pitch:.4f}, {yaw:.4f}]',
            replace(mount, axis_rpy=(roll + pi, pitch, yaw)),
        ),
    ):
        view = synthesize_cylinder(sweep, other, PanoramaConfig(blend='feather'))
        try:
            locate_sweep(sweep, view, room, other, config)
        except LandmarkNavError:
            continue
        return f'the {what} is mounted upside down, as the papers show it: set {remedy}'
    return None
