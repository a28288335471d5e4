"""PNG and JPEG: the size is known, and bounded, before memory is taken."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from landmark_nav.errors import LandmarkNavError
from landmark_nav.image_codec import decode_image, encode_image, image_size

NOISE = np.random.default_rng(5).integers(0, 255, (37, 91, 3)).astype(np.uint8)


def jpeg(*options):
    return encode_image(NOISE, '.jpg', options).tobytes()


def png_of_size(width, height):
    """A complete PNG header; what follows is empty."""
    chunk = b'IHDR' + struct.pack('>IIBBBBB', width, height, 8, 0, 0, 0, 0)
    length, check = struct.pack('>I', 13), struct.pack('>I', zlib.crc32(chunk))
    return b'\x89PNG\r\n\x1a\n' + length + chunk + check


def jpeg_of_size(width, height):
    """A JPEG whose header gives another size than its content has."""
    data = jpeg()
    at = data.index(b'\xff\xc0') + 5
    return data[:at] + struct.pack('>HH', height, width) + data[at + 4 :]


@pytest.mark.parametrize(
    'data',
    [
        encode_image(NOISE, '.png').tobytes(),
        jpeg(),
        jpeg(cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
        jpeg()[:2] + b'\xff' * 40 + jpeg()[2:],
        jpeg()[:2] + b'between\x00' + jpeg()[2:],
    ],
)
def test_the_size_is_read_from_the_header(data):
    assert image_size(data) == (91, 37)
    assert image_size(np.frombuffer(data, np.uint8)) == (91, 37)


def test_no_damage_gives_a_size_that_is_not_the_decoded_one():
    """What the header says bounds the memory: the decoder must not see another size."""
    rng, data = np.random.default_rng(3), jpeg()[:700]
    for _ in range(3000):
        damaged = np.frombuffer(data, np.uint8).copy()
        damaged[rng.integers(2, len(data), 4)] = rng.integers(0, 256, 4)
        try:
            size = image_size(damaged)
            image = decode_image(damaged, max_pixels=10**6)
        except LandmarkNavError:
            continue
        assert image.shape[1::-1] == size


@pytest.mark.parametrize('data', [png_of_size(30000, 30000), jpeg_of_size(65000, 16000)])
def test_an_image_of_absurd_size_is_refused_before_memory_is_taken(data):
    with pytest.raises(LandmarkNavError, match='pixels: reduce it'):
        decode_image(data)


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


def test_sixteen_bits_are_kept():
    deep = np.random.default_rng(4).integers(0, 65535, (20, 30)).astype(np.uint16)
    back = decode_image(encode_image(deep, '.png'), cv2.IMREAD_UNCHANGED)
    assert back.dtype == np.uint16
    assert np.array_equal(back, deep)
