"""Images or a mount that are another way than given: the reference papers fit without that."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from math import pi

import numpy as np

from landmark_nav.geometry.angles import wrap_one_rad
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.panorama import PanoramaConfig, synthesize_cylinder
from landmark_nav.learning.reference_area import papers_fit, ReferenceAreaConfig
from landmark_nav.types import CameraFrame, ImageArray, Sweep

__all__ = ['why_seen_otherwise']

# Nobody writes less.
_HARDLY_RAD = 1e-3


def why_seen_otherwise(
    sweep: Sweep, room: Room, mount: PanTiltMount, config: ReferenceAreaConfig
) -> str | None:
    """What to change if that makes the papers fit; None if nothing does."""
    for why, seen, mounted in _otherwise(sweep, mount):
        view = synthesize_cylinder(seen, mounted, PanoramaConfig(blend='feather'))
        if papers_fit(seen, view, room, mounted, config):
            return f'{why}, as the papers show'
    return None


def _otherwise(sweep: Sweep, mount: PanTiltMount) -> Iterator[tuple[str, Sweep, PanTiltMount]]:
    """What is wrong and what to do, and the sweep and the mount without it."""
    roll, pitch, yaw = mount.axis_rpy
    upside_down = 'is mounted the other way up: set'
    yield (
        f'the camera {upside_down} camera_roll: {_turned(mount.camera_roll_rad)}',
        sweep,
        replace(mount, camera_roll_rad=mount.camera_roll_rad + pi),
    )
    yield (
        f'the pan unit {upside_down} pan_axis rpy: [{_turned(roll)}, {pitch:.4f}, {yaw:.4f}]',
        sweep,
        replace(mount, axis_rpy=(roll + pi, pitch, yaw)),
    )
    if sweep.frames[0].image.ndim == 3:
        exchanged = _changed(sweep, lambda image: image[..., ::-1])
        yield 'red and blue are exchanged: name the encoding (rgb8, bgr8) right', exchanged, mount
    for what, flip in (('top to bottom', np.flipud), ('left to right', np.fliplr)):
        flipped = _changed(sweep, flip)
        yield f'images are flipped {what}: publish them as they are', flipped, mount


def _changed(sweep: Sweep, change: Callable[[ImageArray], ImageArray]) -> Sweep:
    def frame(one: CameraFrame) -> CameraFrame:
        return replace(one, image=np.ascontiguousarray(change(one.image)))

    return replace(sweep, frames=tuple(map(frame, sweep.frames)))


def _turned(angle_rad: float) -> str:
    """Angle and half a turn, as one writes it."""
    angle_rad = wrap_one_rad(angle_rad + pi)
    return '0' if abs(angle_rad) < _HARDLY_RAD else f'{angle_rad:.4f}'
