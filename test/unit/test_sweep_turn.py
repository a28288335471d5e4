"""Images turn as the reported pan: sign, scale, focal length."""

from dataclasses import replace

import numpy as np
import pytest
from turning_camera import turn_sweep

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.calibration import check_turn, measure_turn

MOUNT = PanTiltMount((0.1, 0.0, 1.0))
CAMERA = CameraModel(160, 120, 150.0, 150.0, 79.5, 59.5)
PANS = -np.pi + np.radians(10.0) * np.arange(36)


@pytest.fixture(scope='module')
def turn():
    return turn_sweep(CAMERA, MOUNT, PANS)


def reported(sweep, pan=lambda pan: pan, focal=1.0):
    camera = replace(CAMERA, fx=focal * CAMERA.fx, fy=focal * CAMERA.fy)
    frames = (replace(f, pan_rad=float(pan(f.pan_rad)), camera=camera) for f in sweep.frames)
    return replace(sweep, frames=tuple(frames))


def test_images_that_turn_with_the_pan_pass(turn):
    check_turn(turn, MOUNT)
    found = measure_turn(turn, MOUNT)
    assert found.ratio == pytest.approx(1.0, abs=0.02)
    assert found.full_turn == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ('change', 'cause'),
    [
        (lambda pan: -pan, 'sign of the pan'),
        (lambda pan: 0.0, 'does not turn'),
        (lambda pan: float(pan > 0.0), 'does not turn'),
        (lambda pan: 0.01 * pan, 'does not turn'),
        (lambda pan: 1.5 * pan, 'times the pan'),
        (lambda pan: np.degrees(pan), 'degrees'),
    ],
)
def test_a_pan_that_is_not_that_of_the_images_is_refused(turn, change, cause):
    with pytest.raises(LandmarkNavError, match=cause):
        check_turn(reported(turn, pan=change), MOUNT)


@pytest.mark.parametrize('focal', [0.5, 1.5, 2.0])
def test_a_focal_length_of_another_image_size_is_distinguished_from_a_wrong_pan(turn, focal):
    with pytest.raises(LandmarkNavError, match='focal length'):
        check_turn(reported(turn, focal=focal), MOUNT)


def test_a_camera_that_stands_still_while_the_pan_turns_is_refused(turn):
    still = turn.frames[0].image
    frozen = replace(turn, frames=tuple(replace(f, image=still) for f in turn.frames))
    with pytest.raises(LandmarkNavError, match='do not turn'):
        check_turn(frozen, MOUNT)


def test_a_unit_that_hangs_upside_down_and_reports_it_passes():
    over = replace(MOUNT, axis_rpy=(np.pi, 0.0, 0.0))
    check_turn(turn_sweep(CAMERA, over, PANS), over)
