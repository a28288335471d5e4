"""What a sweep shows of camera and mount: mended where it is wrong, left alone where right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import draw_sweep, rectangle_room, textured_room
from turning_camera import turn_sweep

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.calibration import (
    calibrate_sweep,
    CalibrationConfig,
    SweepCalibration,
)
from landmark_nav.types import FloatArray, Sweep

MOUNT = PanTiltMount((0.1, 0.0, 1.0))
TRUE = CameraModel(240, 200, 230.0, 230.0, 119.5, 99.5, 'plumb_bob', (-0.06, 0.0, 0.0, 0.0, 0.0))
PANS = -np.pi + np.radians(10.0) * np.arange(36)


@pytest.fixture(scope='module')
def turn() -> Sweep:
    return turn_sweep(TRUE, MOUNT, PANS)


def reported(
    sweep: Sweep, focal: float = 1.0, scale: float = 1.0, tilt: float = 0.0, roll: float = 0.0
) -> Sweep:
    """The same images with wrong figures beside them."""
    camera = replace(TRUE, fx=TRUE.fx * focal, fy=TRUE.fy * focal)
    return replace(
        sweep,
        frames=tuple(
            replace(
                frame,
                camera=camera,
                pan_rad=frame.pan_rad * scale,
                tilt_rad=frame.tilt_rad + tilt,
                roll_rad=frame.roll_rad + roll,
            )
            for frame in sweep.frames
        ),
    )


def used(found: SweepCalibration) -> set[str]:
    return {term.name for term in found.quality.calibration if term.used}


def test_what_is_right_is_left_alone(turn: Sweep) -> None:
    found = calibrate_sweep(turn, MOUNT, CalibrationConfig())
    assert used(found) == set()
    assert found.sweep.frames[5].camera == TRUE
    assert found.sweep.frames[5].pan_rad == PANS[5]
    assert found.mount == MOUNT
    assert found.quality.closure_rad is not None
    assert abs(np.degrees(found.quality.closure_rad)) < 0.05
    for term in found.quality.calibration:
        assert abs(term.value) < 4.0 * term.sigma, term


@pytest.mark.parametrize(
    ('name', 'wrong', 'value', 'within'),
    [
        ('focal_length', {'focal': 1.015}, -0.0148, 5e-4),
        ('pan_scale', {'scale': 1.005}, -0.00498, 3e-4),
        ('tilt', {'tilt': 0.0175}, -0.0175, 2e-3),
        ('roll', {'roll': -0.0122}, 0.0122, 5e-4),
    ],
)
def test_a_wrong_figure_is_found_and_mended(
    turn: Sweep, name: str, wrong: dict[str, float], value: float, within: float
) -> None:
    found = calibrate_sweep(reported(turn, **wrong), MOUNT, CalibrationConfig())
    assert used(found) == {name}
    term = next(term for term in found.quality.calibration if term.name == name)
    assert term.value == pytest.approx(value, abs=within)
    assert abs(term.value - value) < 4.0 * term.sigma < 0.25 * abs(value)
    assert found.quality.residual_px < 0.15 < found.quality.before_px
    frame = found.sweep.frames[3]
    assert frame.camera.fx == pytest.approx(TRUE.fx, rel=5e-4)
    assert (frame.pan_rad, frame.tilt_rad, frame.roll_rad) == pytest.approx(
        (PANS[3], 0.0, 0.0), abs=2e-3
    )


def test_all_at_once_are_distinguished(turn: Sweep) -> None:
    sweep = reported(turn, 0.985, 0.995, -0.02, 0.015)
    found = calibrate_sweep(sweep, MOUNT, CalibrationConfig())
    assert used(found) == {'focal_length', 'pan_scale', 'tilt', 'roll'}
    frame = found.sweep.frames[30]
    assert frame.camera.fx == pytest.approx(TRUE.fx, rel=1e-3)
    assert (frame.pan_rad, frame.roll_rad) == pytest.approx((PANS[30], 0.0), abs=1e-3)
    assert frame.tilt_rad == pytest.approx(0.0, abs=3e-3)


def test_nothing_is_used_unless_asked_for(turn: Sweep) -> None:
    sweep = reported(turn, focal=1.015)
    found = calibrate_sweep(sweep, MOUNT, CalibrationConfig(enabled=False))
    assert used(found) == set()
    assert found.sweep.frames[0].camera == sweep.frames[0].camera
    assert next(t for t in found.quality.calibration if t.name == 'focal_length').value < -0.01


def test_a_part_of_a_turn_does_not_close(turn: Sweep) -> None:
    part = reported(replace(turn, frames=turn.frames[5:20]), scale=1.005)
    found = calibrate_sweep(part, MOUNT, CalibrationConfig())
    assert found.quality.closure_rad is None
    # Pan scale and focal length are one number there; the encoder is believed.
    assert 'pan_scale' not in {term.name for term in found.quality.calibration}


def test_a_blank_wall_leaves_the_closure_unknown_and_is_reported(turn: Sweep) -> None:
    blank = np.full_like(turn.frames[0].image, 128)
    frames = [replace(f, image=blank) if 15 <= k < 21 else f for k, f in enumerate(turn.frames)]
    found = calibrate_sweep(replace(turn, frames=tuple(frames)), MOUNT, CalibrationConfig())
    assert found.quality.calibration
    assert found.quality.closure_rad is None
    gaps_deg = np.degrees(found.quality.gaps_rad)
    assert len(gaps_deg)
    assert np.all((gaps_deg > -50.0) & (gaps_deg < 50.0))
    assert f'closure unknown: nothing to match near pan {gaps_deg[0]:.0f}' in str(found.quality)
    whole = calibrate_sweep(turn, MOUNT, CalibrationConfig()).quality
    assert whole.gaps_rad == ()
    assert 'closure error' in str(whole)


def test_frames_that_share_nothing_gives_nothing(turn: Sweep) -> None:
    blank = np.full_like(turn.frames[0].image, 128)
    plain = replace(turn, frames=tuple(replace(f, image=blank) for f in turn.frames))
    for sweep in (plain, replace(turn, frames=turn.frames[:2])):
        found = calibrate_sweep(sweep, MOUNT, CalibrationConfig())
        assert found.quality.calibration == ()
        assert found.sweep is sweep


def test_a_camera_off_its_axis_is_found_by_the_walls_distance() -> None:
    room = rectangle_room(4.0, 3.0)
    scene = textured_room(room, seed=1, feature_m=0.05)
    true = PanTiltMount((0.0, 0.0, 1.2), optical_center_offset=(0.03, -0.02, 0.0))
    camera = CameraModel(200, 160, 180.0, 180.0, 99.5, 79.5)
    pose = np.array([1.4, 1.2, 0.5])
    sweep = draw_sweep(scene, camera, true, pose, np.radians(np.arange(0.0, 360.0, 12.0)))

    def range_m(azimuth: FloatArray, tangent: FloatArray) -> FloatArray:
        return room.raycast(pose[:2], azimuth + pose[2])[0]

    centred = replace(true, optical_center_offset=(0.0, 0.0, 0.0))
    found = calibrate_sweep(sweep, centred, CalibrationConfig(), range_m)
    assert used(found) == {'forward', 'left'}
    assert found.mount.optical_center_offset == pytest.approx((0.03, -0.02, 0.0), abs=4e-3)
    assert used(calibrate_sweep(sweep, true, CalibrationConfig(), range_m)) == set()
