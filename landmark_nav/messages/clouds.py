"""PointCloud2 <-> NumPy structured arrays."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.buffers import bytes_array
from landmark_nav.messages.factory import MessageFactory

__all__ = ['pack_cloud', 'unpack_cloud']

# sensor_msgs/PointField datatype codes.
_CODES = {'i1': 1, 'u1': 2, 'i2': 3, 'u2': 4, 'i4': 5, 'u4': 6, 'f4': 7, 'f8': 8}
_TYPES = {code: name for name, code in _CODES.items()}


def pack_cloud(
    factory: MessageFactory, header: Any, points: npt.NDArray[np.void], dense: bool = True
) -> Any:
    """
    Build a PointCloud2 out of a structured array.

    Parameters
    ----------
    factory : MessageFactory
        Builds the message.
    header : std_msgs/Header
        Stamp and frame.
    points : ndarray of a structured dtype, shape (n,)
        Little-endian scalars or one-dimensional sub-arrays.
    dense : bool
        Whether all points are valid, that is without NaN.

    """
    fields = []
    layout: Mapping[str, Any] = points.dtype.fields or {}
    for name, (scalar, offset, *_) in layout.items():
        base, shape = scalar.subdtype or (scalar, (1,))
        fields.append(
            factory(
                'sensor_msgs/msg/PointField',
                name=name,
                offset=int(offset),
                datatype=_CODES[base.str[1:]],
                count=int(np.prod(shape)),
            )
        )
    size = points.dtype.itemsize
    return factory(
        'sensor_msgs/msg/PointCloud2',
        header=header,
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=size,
        row_step=size * len(points),
        data=np.frombuffer(points.tobytes(), dtype=np.uint8),
        is_dense=dense,
    )


def unpack_cloud(msg: Any, required: Iterable[str]) -> npt.NDArray[np.void]:
    """
    Read the points of a PointCloud2 as a structured array, (n,).

    Raises
    ------
    LandmarkNavError
        A field of `required` is not there, or the sizes contradict each other.

    """
    names = [f.name for f in msg.fields]
    missing = [name for name in required if name not in names]
    if missing:
        raise LandmarkNavError(
            f'point cloud lacks the field {", ".join(missing)} (it has {", ".join(names)}): '
            'publish it from landmark_nav'
        )
    order = '>' if msg.is_bigendian else '<'
    formats: list[Any] = []
    for f in msg.fields:
        if f.datatype not in _TYPES:
            raise LandmarkNavError(f'point cloud field {f.name} has the unknown type {f.datatype}')
        scalar = order + _TYPES[f.datatype]
        formats.append(scalar if f.count <= 1 else (scalar, (int(f.count),)))
    data = bytes_array(msg.data)
    count = int(msg.width) * int(msg.height)
    row_bytes = int(msg.width) * int(msg.point_step)
    if len(data) < int(msg.height) * int(msg.row_step) or msg.row_step < row_bytes:
        raise LandmarkNavError(
            f'point cloud of {msg.width} x {msg.height} points of {msg.point_step} bytes holds '
            f'{len(data)} bytes in rows of {msg.row_step}: its publisher is broken'
        )
    try:
        dtype = np.dtype(
            {
                'names': names,
                'formats': formats,
                'offsets': [int(f.offset) for f in msg.fields],
                'itemsize': int(msg.point_step),
            }
        )
    except ValueError as error:
        raise LandmarkNavError(f'point cloud fields do not fit its points: {error}') from error
    if count == 0:
        return np.empty(0, dtype=dtype)
    rows = data[: int(msg.height) * int(msg.row_step)].reshape(int(msg.height), -1)
    packed = np.ascontiguousarray(rows[:, :row_bytes])
    return packed.reshape(-1).view(dtype)
