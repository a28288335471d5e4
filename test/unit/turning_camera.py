"""Sweeps of a camera that turns on the spot amid a texture infinitely far away."""

from __future__ import annotations

import numpy as np

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.types import CameraFrame, FloatArray, Sweep

__all__ = ['turn_sweep']


def texture(directions: FloatArray) -> FloatArray:
    """Grey of directions (..., 3): a smooth pattern that differs everywhere."""
    rng = np.random.default_rng(5)
    waves = rng.normal(size=(60, 3))
    waves *= rng.uniform(10.0, 70.0, (60, 1)) / np.linalg.norm(waves, axis=1, keepdims=True)
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    values = np.sin(unit @ waves.T + rng.uniform(0.0, 6.28, 60)).sum(-1)
    return np.asarray(128.0 + 14.0 * values)


def turn_sweep(
    camera: CameraModel,
    mount: PanTiltMount,
    pans: FloatArray,
    tilt_rad: float = 0.0,
    roll_rad: float = 0.0,
) -> Sweep:
    """Frames as they look at true angles."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.unproject(np.stack([u, v], -1))
    frames = []
    for k, pan in enumerate(pans):
        rotation, _ = mount.camera_pose_base(pan, tilt_rad, roll_rad)
        grey = np.clip(np.rint(texture(rays @ rotation.T)), 0, 255).astype(np.uint8)
        image = np.dstack([grey] * 3)
        frames.append(CameraFrame(k, image, camera, float(pan), tilt_rad, roll_rad))
    return Sweep(0, tuple(frames))
