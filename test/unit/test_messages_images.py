"""Pictures and cameras come back from their messages, or are refused by name."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from wire import both, FACTORY, over_the_wire, STAMP

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel
from landmark_nav.messages import decode, encode


@both
@pytest.mark.parametrize('shape', [(5, 7), (5, 7, 3)])
def test_image_comes_back(deliver, shape):
    picture = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    msg = deliver(encode.image(FACTORY, picture, STAMP, 'cam'))
    assert decode.stamp_ns(msg.header) == STAMP
    np.testing.assert_array_equal(decode.image(msg), picture)


@both
def test_every_encoding_becomes_bgr_or_grey(deliver):
    rng = np.random.default_rng(1)
    bgr = rng.integers(0, 256, (4, 6, 3)).astype(np.uint8)
    alpha = np.full((4, 6, 1), 255, np.uint8)
    for encoding, pixels in {
        'rgb8': bgr[..., ::-1],
        'bgra8': np.concatenate([bgr, alpha], -1),
        'rgba8': np.concatenate([bgr[..., ::-1], alpha], -1),
    }.items():
        msg = encode.image(FACTORY, np.ascontiguousarray(pixels), STAMP, '')
        msg.encoding = encoding
        np.testing.assert_array_equal(decode.image(deliver(msg)), bgr)


@pytest.mark.parametrize('packed', [False, True])
def test_pictures_are_grey_on_request(packed):
    bgr = np.zeros((8, 16, 3), np.uint8)
    bgr[:, 8:] = [40, 120, 200]
    if packed:
        data = cv2.imencode('.png', bgr)[1].reshape(-1)
        msg = FACTORY('sensor_msgs/msg/CompressedImage', format='png', data=data)
    else:
        msg = encode.image(FACTORY, bgr, STAMP, '')
    grey = decode.image(msg, grey=True)
    np.testing.assert_allclose(grey, cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), atol=1)
    np.testing.assert_array_equal(decode.image(msg), bgr)


@pytest.mark.parametrize('big', [False, True])
def test_mono16_keeps_the_high_byte_and_padding_of_rows_is_dropped(big):
    words = np.arange(12).reshape(3, 4) * 5000
    rows = np.zeros((3, 11), np.uint8)
    rows[:, :8] = words.astype('>u2' if big else '<u2').view(np.uint8).reshape(3, 8)
    msg = FACTORY(
        'sensor_msgs/msg/Image',
        height=3,
        width=4,
        step=11,
        encoding='mono16',
        is_bigendian=int(big),
        data=rows.reshape(-1),
    )
    np.testing.assert_array_equal(decode.image(msg), words >> 8)


def test_unknown_encoding_is_refused_by_name():
    msg = encode.image(FACTORY, np.zeros((4, 4), np.uint8), STAMP, '')
    msg.encoding = 'bayer_rggb8'
    with pytest.raises(LandmarkNavError, match='bayer_rggb8'):
        decode.image(msg)


@pytest.mark.parametrize('change', [{'step': 3}, {'height': 6}, {'width': 0}])
def test_sizes_that_contradict_each_other_are_refused(change):
    msg = encode.image(FACTORY, np.zeros((4, 4), np.uint8), STAMP, '')
    for name, value in change.items():
        setattr(msg, name, value)
    with pytest.raises(LandmarkNavError, match='broken'):
        decode.image(msg)


@both
def test_jpeg_and_png_decode(deliver):
    ramp = np.tile(np.arange(0, 250, 5, dtype=np.uint8), (40, 1))
    jpeg = encode.compressed_image(FACTORY, ramp, STAMP, 'cam', jpeg_quality=95)
    assert np.abs(decode.image(deliver(jpeg)).astype(int) - ramp).max() < 8
    jpeg.format, jpeg.data = 'bgr8; png compressed bgr8', cv2.imencode('.png', ramp)[1].reshape(-1)
    np.testing.assert_array_equal(decode.image(deliver(jpeg)), ramp)


def test_damaged_and_foreign_compressed_images_are_refused():
    msg = encode.compressed_image(FACTORY, np.zeros((16, 16), np.uint8), STAMP, '')
    msg.data = msg.data[:20]
    with pytest.raises(LandmarkNavError, match='does not decode'):
        decode.image(msg)
    msg.data = msg.data[:0]
    with pytest.raises(LandmarkNavError, match='0 bytes'):
        decode.image(msg)
    msg.format = '16UC1; compressedDepth png'
    with pytest.raises(LandmarkNavError, match='compressedDepth'):
        decode.image(msg)


@both
@pytest.mark.parametrize(
    ('model', 'distortion'),
    [
        ('plumb_bob', (0.1, -0.02, 0.001, 0.0, 0.003)),
        ('equidistant', (0.1, 0.01, 0.0, 0.001)),
        ('rational_polynomial', (0.1, 0.0, 0.0, 0.0, 0.2, 0.1, 0.0, 0.1)),
        ('plumb_bob', ()),
    ],
)
def test_camera_comes_back_as_the_same_object(deliver, model, distortion):
    camera = CameraModel(640, 480, 500.0, 501.0, 320.5, 239.5, model, distortion)
    msg = deliver(encode.camera_info(FACTORY, camera, STAMP, 'cam'))
    decoded = decode.camera_model(msg)
    assert decoded == camera
    assert decode.camera_model(deliver(msg) if deliver is over_the_wire else msg) is decoded


def test_region_and_binning_move_the_principal_point():
    camera = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5)
    msg = encode.camera_info(FACTORY, camera, STAMP, '')
    msg.binning_x = msg.binning_y = 2
    msg.roi = FACTORY(
        'sensor_msgs/msg/RegionOfInterest', x_offset=120, y_offset=40, width=400, height=400
    )
    binned = decode.camera_model(msg)
    assert (binned.width, binned.height) == (200, 200)
    assert (binned.cx, binned.cy) == (99.5, 99.5)
    assert binned.fx == 250.0


def test_unknown_camera_model_is_refused_by_name_and_so_is_an_uncalibrated_one():
    msg = encode.camera_info(FACTORY, CameraModel(64, 64, 50.0, 50.0, 31.5, 31.5), STAMP, '')
    msg.distortion_model = 'thin_prism'
    with pytest.raises(LandmarkNavError, match='thin_prism'):
        decode.camera_model(msg)
    msg.k = np.zeros(9)
    with pytest.raises(LandmarkNavError, match='calibrate'):
        decode.camera_model(msg)
