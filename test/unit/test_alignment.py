"""Frames whose angles, focal length and lens are slightly wrong, mended from overlaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from turning_camera import turn_sweep

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.calibration.alignment import align_sweep
from landmark_nav.learning.calibration.overlap_fit import COMMON, OverlapProblem, track_overlaps
from landmark_nav.types import CameraFrame, Sweep

MOUNT = PanTiltMount((0.1, 0.0, 1.0))
TRUE = CameraModel(200, 240, 300.0, 300.0, 99.5, 119.5, 'plumb_bob', (-0.06, 0.0, 0.0, 0.0, 0.0))
STEP = np.radians(20.0)


PANS = -np.pi + STEP * np.arange(18)


def test_wrong_angles_and_focal_length_are_mended() -> None:
    rng = np.random.default_rng(1)
    true = turn_sweep(TRUE, MOUNT, PANS, 0.01, -0.015)
    given = replace(TRUE, fx=TRUE.fx * 1.01, fy=TRUE.fy * 1.01, distortion=())
    wrong = Sweep(
        0,
        tuple(
            replace(
                frame,
                camera=given,
                pan_rad=frame.pan_rad + rng.normal(0.0, 0.003),
                tilt_rad=0.0,
                roll_rad=0.0,
            )
            for frame in true.frames
        ),
    )
    aligned = align_sweep(wrong, MOUNT)
    assert aligned.quality.residual_px < 0.1 < 1.0 < aligned.quality.before_px
    # The turn closes, so the focal length is absolute; where pan 0 points is not.
    focal = aligned.sweep.frames[0].camera.fx
    assert focal == pytest.approx(TRUE.fx, rel=2e-3)
    assert aligned.sweep.frames[0].camera.distortion[0] == pytest.approx(-0.06, abs=0.01)
    assert abs(np.degrees(aligned.quality.closure_rad)) < 0.05
    pan = np.array([frame.pan_rad for frame in aligned.sweep.frames]) - PANS
    assert np.std(pan) < 2e-4
    roll = np.array([frame.roll_rad for frame in aligned.sweep.frames])
    assert np.abs(roll + 0.015).max() < 2e-3


@pytest.mark.parametrize('k1', [0.0, -0.14])
def test_the_focal_length_does_not_hang_on_the_distortion(k1: float) -> None:
    true = replace(TRUE, distortion=(k1,))
    given = replace(TRUE, fx=1.02 * TRUE.fx, fy=1.02 * TRUE.fx, distortion=())
    frames = turn_sweep(true, MOUNT, PANS).frames
    sweep = Sweep(0, tuple(replace(frame, camera=given) for frame in frames))
    aligned = align_sweep(sweep, MOUNT)
    lens = aligned.sweep.frames[0].camera
    assert lens.fx == pytest.approx(TRUE.fx, rel=2e-3)
    found = lens.distortion[0] if lens.distortion else 0.0
    assert found == pytest.approx(k1, abs=0.01) if k1 else found == 0.0
    # What is given is what a lens without distortion would need for the turn to close.
    problem = OverlapProblem(track_overlaps(aligned.sweep, MOUNT, True), sweep, MOUNT)
    plain = problem.fit([COMMON.index('focal_length')], (0.03, 0.01, 0.01))
    assert aligned.focal_px == pytest.approx(given.fx * np.exp(plain.common[0]), rel=4e-3)
    assert aligned.focal_px == pytest.approx(given.fx * aligned.focal_scale)


def test_right_angles_stay() -> None:
    sweep = turn_sweep(TRUE, MOUNT, PANS)
    aligned = align_sweep(sweep, MOUNT)
    assert aligned.quality.residual_px < 0.05
    assert aligned.focal_scale == pytest.approx(1.0, abs=1e-3)
    for before, after in zip(sweep.frames, aligned.sweep.frames, strict=True):
        assert abs(after.pan_rad - before.pan_rad) < 3e-4
        assert abs(after.roll_rad) < 3e-4


def test_too_few_frames_or_no_texture_is_reported() -> None:
    sweep = turn_sweep(TRUE, MOUNT, PANS[:2])
    with pytest.raises(LandmarkNavError, match='2 frames are too few to align'):
        align_sweep(sweep, MOUNT)
    blank = np.full((TRUE.height, TRUE.width, 3), 128, np.uint8)
    plain = Sweep(0, tuple(CameraFrame(k, blank, TRUE, pan) for k, pan in enumerate(PANS)))
    with pytest.raises(LandmarkNavError, match='0 matches between neighbouring frames'):
        align_sweep(plain, MOUNT)
