"""PNG and JPEG in memory: size from the header, decoding and encoding."""

from __future__ import annotations

from collections.abc import Sequence
import struct

import cv2
import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError

# Size of 8K video; larger images are refused before memory is allocated.
MAX_PIXELS = 7680 * 4320

# Limit of scans: each scan of a progressive JPEG is a pass over all pixels, even if it is short.
_MAX_SCANS = 100

_PNG = b'\x89PNG\r\n\x1a\n'
# JPEG markers: those of frames are followed by the size; those in `_LONE` have no content.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_LONE = frozenset({0x01, *range(0xD0, 0xD9)})
_SCAN, _END = 0xDA, 0xD9


def image_size(data: bytes | npt.NDArray[np.uint8]) -> tuple[int, int]:
    """
    Width and height of a PNG or JPEG, from its header alone.

    Source: PNG (ISO/IEC 15948) 11.2.2, JPEG (ITU-T T.81) B.1 and B.2. Bytes between two segments
    of a JPEG are skipped, as in libjpeg: the result is the size that it decodes.

    Raises `LandmarkNavError`: the data is neither, or ends before the size.
    """
    content = data if isinstance(data, bytes) else data.tobytes()
    if content[:8] == _PNG and content[12:16] == b'IHDR' and len(content) >= 24:
        width, height = struct.unpack('>II', content[16:24])
    elif content[:2] == b'\xff\xd8':
        width, height = _jpeg_size(content)
    else:
        width = height = 0
    if not width or not height:
        raise LandmarkNavError('is neither a PNG nor a JPEG, or is cut off: write it again')
    return width, height


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height of the first frame; 0, 0 if there is none."""
    at = 2
    while (at := data.find(b'\xff', at)) >= 0 and at + 9 <= len(data):
        marker = data[at + 1]
        if marker in _FRAMES:
            height, width = struct.unpack('>HH', data[at + 5 : at + 9])
            return width, height
        if marker in (_SCAN, _END):
            break
        if marker == 0xFF:  # a fill byte
            at += 1
        elif marker == 0x00 or marker in _LONE:
            at += 2
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], 'big')
    return 0, 0


def decode_image(
    data: bytes | npt.NDArray[np.uint8], mode: int = cv2.IMREAD_COLOR, max_pixels: int = MAX_PIXELS
) -> npt.NDArray[np.generic]:
    """
    Decode a PNG or JPEG with `cv2.imdecode` in `mode`.

    Raises `LandmarkNavError`: the data is neither, is damaged, or has more than `max_pixels`.
    """
    content = data if isinstance(data, bytes) else data.tobytes()
    width, height = image_size(content)
    if width * height > max_pixels:
        raise LandmarkNavError(
            f'has {width} x {height} pixels: reduce it to {max_pixels / 1e6:.3g} million at most'
        )
    scans = content.count(b'\xff\xda')
    if content[:1] == b'\xff' and scans > _MAX_SCANS:
        raise LandmarkNavError(f'is a JPEG of {scans} scans: write it again as a baseline JPEG')
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), mode)
    except cv2.error:
        image = None
    if image is None or not image.size:
        raise LandmarkNavError(f'{len(content)} bytes do not decode: the image is damaged')
    return np.asarray(image)


def encode_image(
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], suffix: str, options: Sequence[int] = ()
) -> npt.NDArray[np.uint8]:
    """
    Encode an image in the format of a suffix (``.png``, ``.jpg``): bytes (n,).

    Raises `ValueError`: OpenCV cannot encode this shape or type in that format.
    """
    done, data = cv2.imencode(suffix, image, list(options))
    if not done:
        raise ValueError(f'an image of shape {image.shape} cannot be written as {suffix}')
    return np.asarray(data, np.uint8).reshape(-1)
