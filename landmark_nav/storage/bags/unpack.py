"""Compressed data, unpacked with a bound that does not trust what the data declares."""

from __future__ import annotations

import bz2
from pathlib import Path
from tempfile import gettempdir
from typing import Any, BinaryIO, IO

import lz4.frame
import zstandard

from landmark_nav.errors import LandmarkNavError, why

__all__ = ['CHUNK_BYTES', 'most_bytes', 'unpack', 'unpack_file']

# A recorder writes chunks of 1 to 10 MB.
CHUNK_BYTES = 256 * 2**20
# No sensor data is as redundant, beyond the first bytes of a chunk and of a file.
_RATIO, _SMALL_BYTES = 300, 64 * 2**20
_SMALL_FILE_BYTES = 2**29
_BLOCK_BYTES = 2**20


def most_bytes(size: int) -> int:
    """How many bytes a file of a size unpacks to, chunks and all, at most."""
    return max(CHUNK_BYTES, _RATIO * size)


def unpack(data: bytes, compression: str, size: int | None) -> bytes:
    """
    Content of a chunk.

    Parameters
    ----------
    data : bytes
        As it lies in the file.
    compression : str
        ``zstd``, ``lz4`` or ``bz2``; empty or ``none`` where it is not compressed.
    size : int or None
        How many bytes it declares to hold; None where it does not say.

    Raises
    ------
    ValueError
        It holds fewer bytes or more, or more than any recorder puts into one chunk.

    """
    limit = min(CHUNK_BYTES, max(_SMALL_BYTES, _RATIO * len(data)))
    if size is not None and size > limit:
        raise ValueError(f'a chunk of {len(data)} bytes unpacks to {size} bytes')
    most = (limit if size is None else size) + 1
    content: bytes
    if compression in ('', 'none'):
        content = data
    elif compression == 'zstd':
        content = zstandard.ZstdDecompressor().stream_reader(data).read(most)
    elif compression == 'lz4':
        content = lz4.frame.LZ4FrameDecompressor().decompress(data, most)
    elif compression == 'bz2':
        content = bz2.BZ2Decompressor().decompress(data, most)
    else:
        raise ValueError(f'chunks compressed by {compression!r} cannot be read')
    if len(content) == most or (size is not None and len(content) < size):
        raise ValueError('a chunk does not unpack to the size that it declares')
    return content


def unpack_file(path: Path, target: IO[bytes]) -> None:
    """
    Write the content of a file compressed by zstd or lz4 to `target`.

    Raises
    ------
    LandmarkNavError
        It is damaged, unpacks to more than a recording does, or the disk is full.

    """
    most = max(_SMALL_FILE_BYTES, most_bytes(path.stat().st_size))
    written = 0
    try:
        with path.open('rb') as stream, _opened(stream) as content:
            while block := content.read(_BLOCK_BYTES):
                written += len(block)
                if written > most:
                    raise LandmarkNavError(
                        f'{path}: unpacks to over {most / 1e9:.1f} GB, which no recording of its '
                        'size does: unpack it yourself if you trust it'
                    )
                target.write(block)
    except OSError as error:
        raise LandmarkNavError(f'{gettempdir()}: {path} unpacks to there: {why(error)}') from error
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise LandmarkNavError(f'{path}: damaged, it cannot be unpacked ({error})') from error


def _opened(stream: BinaryIO) -> Any:
    """Reader of the content of a compressed stream."""
    zstd = stream.read(4) == b'\x28\xb5\x2f\xfd'
    stream.seek(0)
    if zstd:
        return zstandard.ZstdDecompressor().stream_reader(stream, read_across_frames=True)
    return lz4.frame.LZ4FrameFile(stream)
