"""Calibration by a sweep: errors of camera and mount are corrected, right values are kept."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import Board, draw_sweep, rectangle_room, smooth_texture, textured_room, turn_sweep
from scipy.special import chdtri

from landmark_nav.calibration import Calibration, NAMES, shown
from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.calibration.sweep_calibration import (
    align_sweep,
    calibrate_sweep,
    with_overlaps,
)
from landmark_nav.types import CameraFrame, Sweep

MOUNT = PanTiltMount((0.1, 0.0, 1.0))
PRIOR = Calibration.of_mount(MOUNT)
TRUE = CameraModel(240, 200, 230.0, 230.0, 119.5, 99.5, 'plumb_bob', (-0.06, 0.0, 0.0, 0.0, 0.0))
PANS = -np.pi + np.radians(10.0) * np.arange(36)


@pytest.fixture(scope='module')
def turn():
    return turn_sweep(TRUE, MOUNT, PANS)


def reported(sweep, focal=1.0, scale=1.0, tilt=0.0, roll=0.0):
    """The same images with wrong figures beside them."""
    camera = replace(TRUE, fx=TRUE.fx * focal, fy=TRUE.fy * focal)
    return replace(
        sweep,
        frames=tuple(
            replace(
                frame, camera=camera, pan_rad=frame.pan_rad * scale,
                tilt_rad=frame.tilt_rad + tilt, roll_rad=frame.roll_rad + roll,
            )
            for frame in sweep.frames
        ),
    )  # fmt: skip


def used(found):
    return {term.name for term in found.quality.calibration if term.significant}


def test_what_is_right_is_left_alone(turn):
    found = calibrate_sweep(turn, PRIOR)
    assert used(found) == set()
    assert found.sweep.frames[5].camera == TRUE
    assert found.sweep.frames[5].pan_rad == PANS[5]
    assert found.mount == MOUNT
    assert abs(np.degrees(found.quality.closure_rad)) < 0.05
    for term in found.quality.calibration:
        assert abs(term.value) < 4.0 * term.sigma, term


@pytest.mark.parametrize(
    ('wrong', 'found_values'),
    [
        ({'focal': 1.015}, {'focal_length': (-0.0148, 5e-4)}),
        ({'scale': 1.005}, {'pan_scale': (-0.00498, 3e-4)}),
        ({'tilt': 0.0175}, {'tilt': (-0.0175, 2e-3)}),
        ({'roll': -0.0122}, {'roll': (0.0122, 5e-4)}),
        (
            {'focal': 0.985, 'scale': 0.995, 'tilt': -0.02, 'roll': 0.015},
            {
                'focal_length': (0.0152, 1e-3),
                'pan_scale': (0.00503, 1e-3),
                'tilt': (0.02, 3e-3),
                'roll': (-0.015, 1e-3),
            },
        ),
    ],
    ids=lambda values: ' '.join(values),
)
def test_wrong_figures_are_found_and_corrected(turn, wrong, found_values):
    found = calibrate_sweep(reported(turn, **wrong), PRIOR)
    terms = {term.name: term for term in found.quality.calibration if term.significant}
    assert {*terms} >= {*found_values}
    for name, (value, within) in found_values.items():
        assert terms[name].value == pytest.approx(value, abs=within)
        assert abs(terms[name].value - value) < 4.0 * terms[name].sigma < 0.25 * abs(value)
    assert found.quality.residual_px < 0.15 < found.quality.before_px
    frame = found.sweep.frames[3]
    assert frame.camera.fx == pytest.approx(TRUE.fx, rel=1e-3)
    angles = (frame.pan_rad, frame.tilt_rad, frame.roll_rad + found.mount.camera_roll_rad)
    assert angles == pytest.approx((PANS[3], 0.0, 0.0), abs=3e-3)


def test_a_part_of_a_turn_does_not_close(turn):
    part = reported(replace(turn, frames=turn.frames[5:20]), scale=1.005)
    found = calibrate_sweep(part, PRIOR)
    assert found.quality.closure_rad is None
    # Pan scale and focal length are one number there; the encoder is believed.
    assert 'pan_scale' not in {term.name for term in found.quality.calibration}


def test_a_blank_wall_leaves_the_closure_unknown_and_is_reported(turn):
    blank = np.full_like(turn.frames[0].image, 128)
    frames = [replace(f, image=blank) if 15 <= k < 21 else f for k, f in enumerate(turn.frames)]
    found = calibrate_sweep(replace(turn, frames=tuple(frames)), PRIOR)
    assert found.quality.calibration
    assert found.quality.closure_rad is None
    gaps_deg = np.degrees(found.quality.gaps_rad)
    assert len(gaps_deg)
    assert np.all((gaps_deg > -50.0) & (gaps_deg < 50.0))
    assert f'closure unknown: nothing to match near pan {gaps_deg[0]:.0f}' in str(found.quality)
    whole = calibrate_sweep(turn, PRIOR).quality
    assert whole.gaps_rad == ()
    assert 'closure error' in str(whole)


def off_axis_sweep(true, pose, boards=(), glass=(), vignetting=0.0, gain_sigma=0.0):
    """A sweep with a camera off its axis, and the distance of the walls of its room."""
    room = rectangle_room(4.0, 3.0)
    scene = textured_room(room, seed=1, feature_m=0.05)
    walls = [board for n, board in enumerate(scene.boards) if n not in glass]
    scene = replace(scene, boards=(*walls, *boards))
    camera = CameraModel(200, 160, 180.0, 180.0, 99.5, 79.5)
    turn = np.radians(np.arange(0.0, 360.0, 12.0))
    sweep = draw_sweep(scene, camera, true, np.array(pose), turn)
    square = np.sum(camera.ray_grid[..., :2].astype(np.float64) ** 2, -1)
    lens = 1.0 - vignetting * square / square.max()
    gains = np.exp(gain_sigma * np.random.default_rng(2).standard_normal(len(sweep.frames)))
    frames = [
        replace(frame, image=np.rint(frame.image * (gain * lens)[..., None]).astype(np.uint8))
        for frame, gain in zip(sweep.frames, gains / gains.max(), strict=True)
    ]

    def range_m(azimuth, tangent):
        return room.raycast(pose[:2], azimuth + pose[2])[0]

    return replace(sweep, frames=tuple(frames)), range_m


def test_a_wrong_principal_point_is_not_taken_for_a_camera_off_its_axis():
    true = PanTiltMount((0.0, 0.0, 1.2), optical_center_offset=(0.03, -0.02, 0.0))
    sweep, range_m = off_axis_sweep(true, (1.4, 1.2, 0.5))
    given = replace(sweep.frames[0].camera, cx=sweep.frames[0].camera.cx + 4.0)
    wrong = replace(sweep, frames=tuple(replace(f, camera=given) for f in sweep.frames))
    centred = replace(true, optical_center_offset=(0.0, 0.0, 0.0))
    found = calibrate_sweep(wrong, Calibration.of_mount(centred), range_m)
    assert used(found) == {'forward', 'left', 'principal_point'}
    assert found.mount.optical_center_offset == pytest.approx((0.03, -0.02, 0.0), abs=6e-3)
    assert found.sweep.frames[0].camera.cx == pytest.approx(99.5, abs=0.5)


def test_a_wrong_exact_offset_of_the_camera_is_not_blamed_on_the_focal_length():
    true = PanTiltMount((0.0, 0.0, 1.2), optical_center_offset=(0.03, -0.02, 0.0))
    sweep, range_m = off_axis_sweep(true, (1.4, 1.2, 0.5))
    centred = replace(true, optical_center_offset=(0.0, 0.0, 0.0))
    prior = Calibration.of_mount(centred, dict.fromkeys(NAMES, 0.0))
    found = calibrate_sweep(sweep, prior)
    assert not found.calibration.sigmas.any()
    with pytest.raises(LandmarkNavError, match='center_x') as refused:
        calibrate_sweep(sweep, prior, range_m, found)
    assert 'focal_scale' not in str(refused.value)


def cupboard(center, normal, width, height=1.1):
    """What stands before a wall; it is lower than the camera unless it is given higher."""
    texture = smooth_texture(np.random.default_rng(3), width, height, 0.05)
    middle = np.array([*center, height / 2.0])
    return Board(middle, np.array([*normal, 0.0]), width, height, texture)


CUPBOARDS = (
    cupboard((2.0, 0.6), (0.0, 1.0), 2.4),
    cupboard((3.2, 1.5), (-1.0, 0.0), 1.6),
    cupboard((2.0, 2.4), (0.0, -1.0), 2.4),
    cupboard((0.5, 1.5), (1.0, 0.0), 1.6),
)


def scenery(away, distance_m=40.0):
    """What is seen through a wall of glass, which is `away` (2,) from the middle of the room."""
    texture = smooth_texture(np.random.default_rng(4), 3.0 * distance_m, 1.5 * distance_m, 1.0)
    center = np.array([2.0 + distance_m * away[0], 1.5 + distance_m * away[1], 1.2])
    return Board(center, -np.array([*away, 0.0]), 3.0 * distance_m, 1.5 * distance_m, texture)


WINDOWS = (scenery((0.0, -1.0)), scenery((1.0, 0.0)), scenery((0.0, 1.0)))


@pytest.mark.parametrize(
    ('offset', 'lean_rad', 'conditions'),
    [
        ((0.05, -0.03), 0.1, {}),
        ((0.05, -0.03), 0.0, {'vignetting': 0.5, 'gain_sigma': 0.15}),
        ((0.08, -0.05), 0.0, {'boards': CUPBOARDS}),
        # As high as the camera sees.
        ((0.015, -0.012), 0.0, {'boards': (cupboard((1.4, 0.55), (0.0, 1.0), 1.6, 2.4),)}),
        ((0.015, -0.012), 0.0, {'boards': WINDOWS[:1], 'glass': (0,)}),
        ((0.015, -0.012), 0.0, {'boards': WINDOWS, 'glass': (0, 1, 2)}),
    ],
    ids=['leaning axis', 'uneven brightness', 'furniture', 'bookcase', 'window', 'glass house'],
)
def test_the_covariance_contains_all_errors(offset, lean_rad, conditions):
    """By two sweeps, of a camera whose offset is not given."""
    true = PanTiltMount((0.0, 0.0, 1.2), (0.0, lean_rad, 0.0), (*offset, 0.0))
    given = replace(true, optical_center_offset=(0.0, 0.0, 0.0))
    prior, nees, count = Calibration.of_mount(given), 0.0, 0
    for pose in ((1.4, 1.2, 0.5), (2.2, 1.7, -2.0)):
        sweep, range_m = off_axis_sweep(true, pose, **conditions)
        found = calibrate_sweep(sweep, prior, range_m)
        found = calibrate_sweep(sweep, prior, range_m, found)
        known = with_overlaps(prior, prior, found.fit)
        shown = known.sigmas < 0.5 * prior.sigmas
        off = (known.values - Calibration.of_mount(true).values)[shown]
        assert {'focal_scale', 'center_x', 'center_y'} <= {*np.array(NAMES)[shown]}
        nees += off @ np.linalg.solve(known.covariance[np.ix_(shown, shown)], off)
        count += len(off)
    assert nees < chdtri(count, 1e-3)


FOLDER = CameraModel(200, 240, 300.0, 300.0, 99.5, 119.5, 'plumb_bob', (-0.06, 0.0, 0.0, 0.0, 0.0))
FEW = -np.pi + np.radians(20.0) * np.arange(18)


def test_rough_angles_of_frames_and_the_focal_length_are_aligned():
    rng = np.random.default_rng(1)
    true = turn_sweep(FOLDER, MOUNT, FEW, 0.01, -0.015)
    given = replace(FOLDER, fx=FOLDER.fx * 1.01, fy=FOLDER.fy * 1.01, distortion=())
    rough = (
        replace(f, camera=given, pan_rad=f.pan_rad + rng.normal(0.0, 0.003), tilt_rad=0.0)
        for f in true.frames
    )
    wrong = Sweep(0, tuple(replace(frame, roll_rad=0.0) for frame in rough))
    aligned, quality = align_sweep(wrong, MOUNT)
    assert quality.residual_px < 0.1 < 1.0 < quality.before_px
    # The turn closes, so the focal length is absolute; where pan 0 points is not.
    camera = aligned.frames[0].camera
    assert camera.fx == pytest.approx(FOLDER.fx, rel=2e-3)
    assert camera.distortion[0] == pytest.approx(-0.06, abs=0.01)
    assert abs(np.degrees(quality.closure_rad)) < 0.05
    angles = np.array([(frame.pan_rad, frame.roll_rad) for frame in aligned.frames])
    assert np.std(angles[:, 0] - FEW) < 2e-4
    assert np.abs(angles[:, 1] + 0.015).max() < 2e-3


def test_too_few_frames_or_no_texture_is_reported():
    with pytest.raises(LandmarkNavError, match='2 frames are too few to align'):
        align_sweep(turn_sweep(FOLDER, MOUNT, FEW[:2]), MOUNT)
    blank = np.full((FOLDER.height, FOLDER.width, 3), 128, np.uint8)
    plain = Sweep(0, tuple(CameraFrame(k, blank, FOLDER, pan) for k, pan in enumerate(FEW)))
    with pytest.raises(LandmarkNavError, match='0 matches between neighbouring frames'):
        align_sweep(plain, MOUNT)


@pytest.mark.parametrize('sigma', [0.00004, 0.004, 3.0])
def test_a_difference_is_shown_with_a_digit_of_its_sigma(sigma):
    value, sigma_shown = map(float, shown(0.41, sigma, '1').split()[:3:2])
    assert sigma_shown == pytest.approx(100.0 * sigma, rel=0.5)
    assert value == pytest.approx(41.0)
