"""Calibrations as drivers publish them: whose pixels K is in follows from the image's size."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from wire import FACTORY, STAMP

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.messages import decode, encode

SENSOR = CameraModel(1280, 960, 900.0, 905.0, 655.0, 470.0, 'plumb_bob', (-0.1, 0.02))
POINTS = np.array([[0.1, -0.05, 1.0], [-0.2, 0.15, 1.0], [0.0, 0.0, 1.0]])


def message(k=None, size=(1280, 960), binning=1, roi=(0, 0, 0, 0), **changes):
    msg = encode.camera_info(FACTORY, SENSOR, STAMP, 'cam')
    msg.width, msg.height = size
    msg.binning_x = msg.binning_y = binning
    x, y, width, height = roi
    msg.roi = FACTORY(
        'sensor_msgs/msg/RegionOfInterest', x_offset=x, y_offset=y, width=width, height=height
    )
    if k is not None:
        msg.k = np.array([k[0], 0.0, k[2], 0.0, k[1], k[3], 0.0, 0.0, 1.0])
    for name, value in changes.items():
        setattr(msg, name, value)
    return msg


ROI = (200, 100, 800, 720)
# fx, fy, cx, cy of the image that remains.
BINNED = (450.0, 452.5, 327.25, 234.75)
CUT = (900.0, 905.0, 455.0, 370.0)
BOTH = (450.0, 452.5, 227.25, 184.75)
FULL = (900.0, 905.0, 655.0, 470.0)


@pytest.mark.parametrize(
    ('msg', 'image', 'expected'),
    [
        (message(), (1280, 960), FULL),
        (message(binning=2), (640, 480), BINNED),
        (message(BINNED, binning=2), (640, 480), BINNED),
        (message(BINNED, (640, 480), binning=2), (640, 480), BINNED),
        (message(FULL, (640, 480), binning=2), (640, 480), BINNED),
        (message(binning=2), (1280, 960), FULL),
        (message(roi=ROI), (800, 720), CUT),
        (message(CUT, roi=ROI), (800, 720), CUT),
        (message(CUT, (800, 720), roi=ROI), (800, 720), CUT),
        (message(binning=2, roi=ROI), (400, 360), BOTH),
        (message(BOTH, binning=2, roi=ROI), (400, 360), BOTH),
        (message(), (640, 480), BINNED),
        (message(BINNED, (640, 480)), (1280, 960), FULL),
        (message(roi=(0, 0, 1280, 960)), (1280, 960), FULL),
    ],
)
def test_camera_of_the_image_that_is_published(msg, image, expected):
    camera = decode.camera_info(msg).for_image(*image)
    assert (camera.width, camera.height) == image
    true = CameraModel(*image, *expected, SENSOR.model, SENSOR.distortion)
    np.testing.assert_allclose(camera.project(POINTS), true.project(POINTS), atol=1e-6)


def test_what_cannot_be_decided_is_taken_as_ros_defines_it_and_reported(caplog):
    roi = (60, 0, 1220, 960)
    info = decode.camera_info(message(roi=roi))
    with caplog.at_level(logging.WARNING, logger='landmark_nav'):
        camera = info.for_image(1220, 960)
    assert (camera.cx, camera.cy) == (595.0, 470.0)
    decode.camera_info(message(roi=roi)).for_image(1220, 960)
    assert len(caplog.records) <= 1


@pytest.mark.parametrize('image', [(640, 360), (1279, 960), (1920, 1440), (1, 1), (65000, 16000)])
def test_an_image_of_another_size_is_refused_with_both_sizes(image):
    with pytest.raises(
        LandmarkNavError, match=rf'{image[0]} x {image[1]}.*1280 x 960'
    ) as reported:
        decode.camera_info(message()).for_image(*image)
    assert len(str(reported.value)) < 200


@pytest.mark.parametrize('model', ['plumb_bob', 'rational_polynomial', 'equidistant', ''])
@pytest.mark.parametrize('count', [0, 4, 5, 8, 12, 14])
def test_every_usual_number_of_coefficients_is_read_or_refused_in_one_line(model, count):
    values = (-0.1, 0.02, 0.001, -0.001, 0.003, 0.01, 0.002, 0.001, 1e-3, 1e-4, 1e-3, 1e-4, 0, 0)
    padded = message(distortion_model=model, d=np.array([*values[:4], *[0.0] * 10][:count]))
    if model or not count:
        camera = decode.camera_model(padded)
        assert camera.distortion == (() if not count else values[:4])
    used = message(distortion_model=model, d=np.array(values[:count]))
    if (model == 'equidistant' and count > 4) or (not model and count):
        with pytest.raises(LandmarkNavError, match='camera model') as reported:
            decode.camera_model(used)
        assert len(str(reported.value)) < 200
    else:
        back = decode.camera_model(encode.camera_info(FACTORY, decode.camera_model(used), 1, ''))
        assert back == decode.camera_model(used)


def test_a_tilted_sensor_and_a_skew_are_refused():
    for change in ({'d': np.array([0.0] * 13 + [0.1])}, {'d': np.array([0.0] * 12 + [0.1])}):
        with pytest.raises(LandmarkNavError, match='coefficients'):
            decode.camera_info(message(**change))
    skewed = message()
    skewed.k[1] = 30.0
    with pytest.raises(LandmarkNavError, match='skew'):
        decode.camera_info(skewed)
    skewed.k[1] = 0.5
    assert decode.camera_model(skewed).fx == 900.0


def test_a_lens_that_folds_is_reported_once(caplog):
    msg = message(d=np.array([-0.4, 0.0, 0.0, 0.0, 0.0]))
    with caplog.at_level(logging.WARNING, logger='landmark_nav'):
        for _ in range(3):
            decode.camera_model(msg)
    assert [('folds back' in r.getMessage()) for r in caplog.records] == [True]
