"""Frames whose angles, focal length and lens are slightly wrong, mended from overlaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.alignment import align_sweep, AlignmentConfig
from landmark_nav.types import CameraFrame, FloatArray, Sweep

MOUNT = PanTiltMount((0.1, 0.0, 1.0))
TRUE = CameraModel(200, 240, 300.0, 300.0, 99.5, 119.5, 'plumb_bob', (-0.06, 0.0, 0.0, 0.0, 0.0))
STEP = np.radians(20.0)


def texture(directions: FloatArray) -> FloatArray:
    """Grey of directions (..., 3): a smooth pattern that differs everywhere."""
    rng = np.random.default_rng(5)
    waves = rng.normal(size=(60, 3))
    waves *= rng.uniform(10.0, 70.0, (60, 1)) / np.linalg.norm(waves, axis=1, keepdims=True)
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    values = np.sin(unit @ waves.T + rng.uniform(0.0, 6.28, 60)).sum(-1)
    return np.asarray(128.0 + 14.0 * values)


def turn(pans: FloatArray, tilt_rad: float = 0.0, roll_rad: float = 0.0) -> Sweep:
    """Frames as they look at true angles."""
    u, v = np.meshgrid(np.arange(TRUE.width), np.arange(TRUE.height))
    rays = TRUE.unproject(np.stack([u, v], -1))
    frames = []
    for k, pan in enumerate(pans):
        rotation, _ = MOUNT.camera_pose_base(pan, tilt_rad, roll_rad)
        grey = np.clip(np.rint(texture(rays @ rotation.T)), 0, 255).astype(np.uint8)
        frames.append(CameraFrame(k, np.dstack([grey] * 3), TRUE, float(pan), tilt_rad, roll_rad))
    return Sweep(0, tuple(frames))


PANS = -np.pi + STEP * np.arange(18)


def test_wrong_angles_and_focal_length_are_mended() -> None:
    rng = np.random.default_rng(1)
    true = turn(PANS, tilt_rad=0.01, roll_rad=-0.015)
    told = replace(TRUE, fx=TRUE.fx * 1.01, fy=TRUE.fy * 1.01, distortion=())
    wrong = Sweep(
        0,
        tuple(
            replace(
                frame,
                camera=told,
                pan_rad=frame.pan_rad + rng.normal(0.0, 0.003),
                tilt_rad=0.0,
                roll_rad=0.0,
            )
            for frame in true.frames
        ),
    )
    aligned = align_sweep(wrong, MOUNT, AlignmentConfig())
    assert aligned.residual_px < 0.1 < 1.0 < aligned.before_px
    # The turn closes, so the focal length is absolute; where pan 0 points is not.
    focal = aligned.sweep.frames[0].camera.fx
    assert focal == pytest.approx(TRUE.fx, rel=2e-3)
    assert aligned.focal_scale == pytest.approx(focal / told.fx)
    pan = np.array([frame.pan_rad for frame in aligned.sweep.frames]) - PANS
    assert np.std(pan) < 2e-4
    roll = np.array([frame.roll_rad for frame in aligned.sweep.frames])
    assert np.abs(roll + 0.015).max() < 2e-3


def test_right_angles_stay() -> None:
    sweep = turn(PANS)
    aligned = align_sweep(sweep, MOUNT, AlignmentConfig())
    assert aligned.residual_px < 0.05
    assert aligned.focal_scale == pytest.approx(1.0, abs=1e-3)
    for before, after in zip(sweep.frames, aligned.sweep.frames, strict=True):
        assert abs(after.pan_rad - before.pan_rad) < 3e-4
        assert abs(after.roll_rad) < 3e-4


def test_too_few_frames_or_no_texture_is_told() -> None:
    sweep = turn(PANS[:2])
    with pytest.raises(LandmarkNavError, match='2 frames are too few to align'):
        align_sweep(sweep, MOUNT, AlignmentConfig())
    blank = np.full((TRUE.height, TRUE.width, 3), 128, np.uint8)
    plain = Sweep(0, tuple(CameraFrame(k, blank, TRUE, pan) for k, pan in enumerate(PANS)))
    with pytest.raises(LandmarkNavError, match='0 matches between neighbouring frames'):
        align_sweep(plain, MOUNT, AlignmentConfig())
