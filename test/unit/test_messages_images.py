"""Images and cameras: encodings, PNG and JPEG of bounded size, or refused by name."""

import logging
import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest
from wire import both, FACTORY, over_the_wire, STAMP

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, MAX_PX_PER_RAD
from landmark_nav.image_codec import decode_image, encode_image
from landmark_nav.messages import decode, encode


def raw(pixels, encoding, padding=0, big=False):
    """Message of pixels (h, w[, channels]) as they lie in memory."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    return FACTORY(
        'sensor_msgs/msg/Image', height=pixels.shape[0], width=pixels.shape[1], step=rows.shape[1],
        encoding=encoding, is_bigendian=int(big), data=rows.reshape(-1),
    )  # fmt: skip


@both
def test_every_encoding_becomes_bgr_or_grey(deliver):
    rng = np.random.default_rng(1)
    bgr = rng.integers(0, 256, (4, 6, 3)).astype(np.uint8)
    alpha = np.full((4, 6, 1), 255, np.uint8)
    rgb, bgra = bgr[..., ::-1], np.concatenate([bgr, alpha], -1)
    rgba, grey = np.concatenate([rgb, alpha], -1), cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    for names, pixels in {
        ('bgr{}', '{}UC3'): bgr,
        ('rgb{}',): rgb,
        ('bgra{}', '{}UC4'): bgra,
        ('rgba{}',): rgba,
    }.items():
        for name in names:
            msg = raw(pixels, name.format(8))
            np.testing.assert_array_equal(decode.image(deliver(msg)), bgr)
            np.testing.assert_allclose(decode.image(msg, grey=True), grey, atol=1)
            for big in (False, True):
                msg = raw(pixels.astype('>u2' if big else '<u2') << 8, name.format(16), big=big)
                np.testing.assert_array_equal(decode.image(deliver(msg)), bgr)


@pytest.mark.parametrize(
    ('encoding', 'shape', 'change'),
    [
        ('mono8', (4, 4), {'step': 3}),
        ('mono8', (4, 4), {'height': 6}),
        ('mono8', (4, 4), {'width': 0}),
        ('nv12', (3, 6), {'height': 3}),
        ('yuyv', (4, 5, 2), {}),
        *((name, (4, 4), {}) for name in ('32FC1', 'bayer_rggb12', 'h264', 'x' * 1000)),
    ],
)
def test_sizes_that_cannot_be_and_unknown_encodings_are_refused(encoding, shape, change):
    msg = raw(np.zeros(shape, np.uint8), encoding)
    for name, value in change.items():
        setattr(msg, name, value)
    words = 'broken' if change or encoding == 'yuyv' else encoding[:10]
    with pytest.raises(LandmarkNavError, match=words) as reported:
        decode.image(msg)
    assert len(str(reported.value)) < 200


def test_damaged_and_foreign_compressed_images_are_refused():
    msg = encode.compressed_image(FACTORY, np.zeros((16, 16), np.uint8), STAMP, '')
    for size, form, words in (
        (20, msg.format, 'does not decode'),
        (0, msg.format, '0 bytes'),
        (0, '16UC1; compressedDepth png', 'compressedDepth'),
    ):
        msg.data, msg.format = msg.data[:size], form
        with pytest.raises(LandmarkNavError, match=words):
            decode.image(msg)


def quarters():
    """Four quarters of one colour each, 32 x 32, BGR."""
    bgr = np.zeros((32, 32, 3), np.uint8)
    for k, colour in enumerate(([200, 60, 40], [40, 180, 60], [50, 70, 210], [120, 120, 120])):
        bgr[16 * (k // 2) :, 16 * (k % 2) :] = colour
    return bgr


def packed(bgr, encoding):
    height, width = bgr.shape[:2]
    if encoding.startswith('bayer'):
        mosaic = np.empty((height, width), np.uint8)
        for k, colour in enumerate(encoding[6:10]):
            part = (slice(k // 2, None, 2), slice(k % 2, None, 2))
            mosaic[part] = bgr[part][..., 'bgr'.index(colour)]
        return raw(mosaic.astype('<u2') << 4 if encoding.endswith('16') else mosaic, encoding)
    i420 = cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV_I420)
    luma, chroma = i420[:height], i420[height:].reshape(2, height // 2, width // 2)
    if encoding.startswith('nv'):
        pairs = np.stack(chroma if encoding == 'nv12' else chroma[::-1], -1)
        msg = raw(np.vstack([luma, pairs.reshape(height // 2, width)]), encoding)
        msg.height = height
        return msg
    pairs = np.stack(np.repeat(chroma, 2, axis=1), -1).reshape(height, width)
    both_bytes = (luma, pairs) if encoding in ('yuv422_yuy2', 'yuyv') else (pairs, luma)
    return raw(np.stack(both_bytes, -1), encoding)


@both
@pytest.mark.parametrize(
    'encoding',
    ['yuv422', 'uyvy', 'yuv422_yuy2', 'yuyv', 'nv12', 'nv21']
    + [f'bayer_{mosaic}{bits}' for mosaic in ('rggb', 'bggr', 'gbrg', 'grbg') for bits in (8, 16)],
)
@pytest.mark.parametrize('padding', [0, 6])
def test_colours_of_cameras_come_out(deliver, encoding, padding):
    bgr = quarters()
    msg = packed(bgr, encoding)
    if padding:
        rows = np.asarray(msg.data).reshape(-1, msg.step)
        msg.data = np.pad(rows, ((0, 0), (0, padding))).reshape(-1)
        msg.step += padding
    msg = deliver(msg)
    inner = np.concatenate([np.arange(4, 12), np.arange(20, 28)])
    found = decode.image(msg)[np.ix_(inner, inner)].astype(int)
    assert np.abs(found - bgr[np.ix_(inner, inner)]).max() <= 8
    grey = decode.image(msg, grey=True)[np.ix_(inner, inner)].astype(int)
    assert np.abs(grey - cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)[np.ix_(inner, inner)]).max() <= 8


@pytest.mark.parametrize('bits', [8, 10, 12, 14, 16])
@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize('encoding', ['mono16', '16UC1', '16UC2'])
def test_the_bits_in_use_become_eight_and_padding_of_rows_is_dropped(bits, big, encoding):
    words = np.linspace(0, 2**bits - 1, 12).astype(int).reshape(3, 4)
    sent = words.astype('>u2' if big else '<u2')
    msg = raw(
        np.repeat(sent[..., None], 2, axis=2) if encoding == '16UC2' else sent, encoding, 3, big
    )
    np.testing.assert_array_equal(decode.image(msg), words >> (bits - 8))


def test_the_depth_of_a_stream_never_shrinks_and_early_images_can_follow():
    depth = decode.BitDepth()
    levels = (250, 1000, 90, 4000, 700)
    seen = []
    for level in levels:
        pixels = np.full((16, 16), level, np.uint16)
        seen.append((decode.image(raw(pixels, 'mono16'), depth=depth), depth.bits))
    assert [bits for _, bits in seen] == [8, 10, 10, 12, 12]
    for level, (pixels, bits) in zip(levels, seen, strict=True):
        np.testing.assert_array_equal(depth.lowered(pixels, bits), level >> 4)


def compressed(data, kind='jpeg'):
    data = np.frombuffer(bytes(data), np.uint8)
    return FACTORY('sensor_msgs/msg/CompressedImage', format=kind, data=data)


def test_an_orientation_tag_turns_nothing():
    wide = np.zeros((32, 64, 3), np.uint8)
    wide[:, 32:] = 255
    jpeg = cv2.imencode('.jpg', wide)[1].tobytes()
    # A TIFF header with one entry: Orientation, SHORT, 6 (turned by 90 degrees).
    entry = struct.pack('>HHIHH', 0x0112, 3, 1, 6, 0)
    exif = b'Exif\x00\x00MM\x00*' + struct.pack('>IH', 8, 1) + entry + bytes(4)
    tagged = jpeg[:2] + b'\xff\xe1' + struct.pack('>H', len(exif) + 2) + exif + jpeg[2:]
    turned = cv2.imdecode(np.frombuffer(tagged, np.uint8), cv2.IMREAD_COLOR)
    assert turned.shape[:2] == (64, 32)
    for grey in (False, True):
        assert decode.image(compressed(tagged), grey=grey).shape[:2] == (32, 64)


CAMERA = CameraModel(1920, 1080, 1400.0, 1405.0, 970.0, 530.0, 'plumb_bob', (-0.1, 0.02))


def spots():
    """Image of that camera with soft spots, and their directions."""
    places = np.array([[200.3, 150.7], [960.2, 540.4], [1700.6, 900.1], [640.9, 820.5]])
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float32)
    image = np.full((CAMERA.height, CAMERA.width), 30.0, np.float32)
    for x, y in places:
        image += 200.0 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 9.0**2))
    return np.rint(image).clip(0, 255).astype(np.uint8), CAMERA.unproject(places)


@pytest.mark.parametrize('form', ['bgr8', 'mono16', '.jpg', '.png'])
@pytest.mark.parametrize('grey', [False, True])
def test_frames_are_reduced_to_the_working_resolution_and_keep_their_directions(form, grey):
    image, rays = spots()
    bgr = np.repeat(image[..., None], 3, axis=2)
    if form.startswith('.'):
        msg = compressed(cv2.imencode(form, bgr)[1], form[1:])
    else:
        msg = raw(bgr if form == 'bgr8' else image.astype('<u2') << 4, form)
    info = decode.camera_info(encode.camera_info(FACTORY, CAMERA, STAMP, 'cam'))
    pixels, camera = decode.camera_image(msg, info, grey)
    assert pixels.shape[:2] == (camera.height, camera.width)
    assert max(camera.fx, camera.fy) < MAX_PX_PER_RAD + 1.0
    level = (pixels if pixels.ndim == 2 else pixels[..., 1]).astype(float) - 30.0
    for u, v in camera.project(rays):
        rows, columns = (slice(round(at) - 12, round(at) + 13) for at in (v, u))
        weight = np.maximum(level[rows, columns] - 20.0, 0.0)
        y, x = np.mgrid[rows, columns]
        found = np.array([np.sum(weight * x), np.sum(weight * y)]) / weight.sum()
        np.testing.assert_allclose(found, [u, v], atol=0.06)


def test_a_header_of_absurd_size_is_refused_before_memory_is_taken():
    jpeg = bytearray(cv2.imencode('.jpg', np.zeros((16, 16), np.uint8))[1].tobytes())
    at = jpeg.index(b'\xff\xc0') + 5
    jpeg[at : at + 4] = struct.pack('>HH', 16000, 65000)
    info = decode.camera_info(encode.camera_info(FACTORY, CAMERA, STAMP, 'cam'))
    tracemalloc.start()
    try:
        for take in (lambda m: decode.image(m), lambda m: decode.camera_image(m, info)):
            with pytest.raises(LandmarkNavError, match='65000 x 16000'):
                take(compressed(jpeg))
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


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


def test_unknown_camera_model_is_refused_by_name_and_so_is_an_uncalibrated_one():
    msg = encode.camera_info(FACTORY, CameraModel(64, 64, 50.0, 50.0, 31.5, 31.5), STAMP, '')
    msg.distortion_model = 'thin_prism'
    with pytest.raises(LandmarkNavError, match='thin_prism'):
        decode.camera_model(msg)
    msg.k = np.zeros(9)
    with pytest.raises(LandmarkNavError, match='calibrate'):
        decode.camera_model(msg)


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


@pytest.mark.parametrize('image', [(640, 360), (1279, 960), (1920, 1440), (1, 1), (65000, 16000)])
def test_an_image_of_another_size_is_refused_with_both_sizes(image):
    with pytest.raises(
        LandmarkNavError, match=rf'{image[0]} x {image[1]}.*1280 x 960'
    ) as reported:
        decode.camera_info(message()).for_image(*image)
    assert len(str(reported.value)) < 200


def test_a_lens_that_folds_is_reported_once(caplog):
    msg = message(d=np.array([-0.4, 0.0, 0.0, 0.0, 0.0]))
    with caplog.at_level(logging.WARNING, logger='landmark_nav'):
        for _ in range(3):
            decode.camera_model(msg)
    assert [('folds back' in r.getMessage()) for r in caplog.records] == [True]


NOISE = np.random.default_rng(5).integers(0, 255, (37, 91, 3)).astype(np.uint8)


def jpeg(*options):
    return encode_image(NOISE, '.jpg', options).tobytes()


def png_of_size(width, height):
    """A complete PNG header; what follows is empty."""
    chunk = b'IHDR' + struct.pack('>IIBBBBB', width, height, 8, 0, 0, 0, 0)
    length, check = struct.pack('>I', 13), struct.pack('>I', zlib.crc32(chunk))
    return b'\x89PNG\r\n\x1a\n' + length + chunk + check


@pytest.mark.parametrize(
    'data',
    [
        *(b'', b'\xff\xd8', b'\x89PNG\r\n\x1a\n', b'GIF89a', jpeg()[:200], png_of_size(0, 5)),
        *(jpeg() + b'\xff\xda' * 1000, png_of_size(20, 30), jpeg()[:2] + b'\xff' * 100_000),
    ],
)
def test_bad_data_is_refused(data):
    with pytest.raises(LandmarkNavError):
        decode_image(data)
    with pytest.raises(LandmarkNavError):
        decode_image(np.frombuffer(data, np.uint8))
