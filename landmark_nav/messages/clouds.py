"""PointCloud2 <-> NumPy structured arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.messages.layouts import Layout


def bytes_array(data: Any) -> npt.NDArray[np.uint8]:
    """
    View a ``uint8[]`` field (ndarray, array.array, bytes or list) as an array (n,).

    Raises `LandmarkNavError`: the field does not hold bytes (a foreign definition of the message).
    """
    try:
        if isinstance(data, np.ndarray):
            return np.ascontiguousarray(data).reshape(-1).view(np.uint8)
        if isinstance(data, list | tuple):
            return np.array(data, dtype=np.uint8)
        return np.frombuffer(data, dtype=np.uint8)
    except (TypeError, ValueError, OverflowError):
        raise LandmarkNavError(
            f'the data of the message are {type(data).__name__}, not bytes: record it again'
        ) from None


# sensor_msgs/PointField datatype codes.
_CODES = {'i1': 1, 'u1': 2, 'i2': 3, 'u2': 4, 'i4': 5, 'u4': 6, 'f4': 7, 'f8': 8}
_TYPES = {code: name for name, code in _CODES.items()}
# Limits far above any map; the joint covariance of 5000 landmarks takes 800 MB.
_MAX_POINTS, _MAX_BYTES = 5000, 2**28


def pack_cloud(
    factory: MessageFactory, header: Any, points: npt.NDArray[np.void], dense: bool = True
) -> Any:
    """
    Build a PointCloud2 out of points (n,) of little-endian scalars or one-dimensional sub-arrays.

    `dense`: all points are valid, none holds NaN.
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


def unpack_cloud(msg: Any, layout: Layout) -> npt.NDArray[np.void]:
    """
    Read the points of a PointCloud2 as a structured array, (n,), of float64 and int64.

    The result has exactly the fields of the layout. Their order, width and byte order in the
    message are free.

    Raises `LandmarkNavError`: a field is missing, has another type or count, or lies outside its
    point; or the sizes contradict each other or the length of the data.
    """
    where = f'point cloud of {layout.topic}'
    height, width, step = int(msg.height), int(msg.width), int(msg.point_step)
    row_step, data = int(msg.row_step), bytes_array(msg.data)
    if row_step < width * step or len(data) < height * row_step:
        raise LandmarkNavError(
            f'{where}: {width} x {height} points of {step} bytes in rows of {row_step} are more '
            f'than its {len(data)} bytes: its publisher is broken'
        )
    sent = _types_sent(msg, layout, where)
    # 64 bits hold every value that a field of a point cloud can have.
    wide = [
        (name, 'f8' if kind.base.kind == 'f' else 'i8', sent.get(name, (kind, 0))[0].shape)
        for name, kind, _ in layout.columns()
    ]
    count, size = width * height, sum(8 * int(np.prod(shape)) for _, _, shape in wide)
    if count > _MAX_POINTS or max(1, count) * max(step, size) > _MAX_BYTES:
        raise LandmarkNavError(
            f'{where} has {count} points of {step} bytes, more than any map: fix its publisher'
        )
    points = np.zeros(count, dtype=wide)
    if count:
        as_sent = np.dtype(
            {
                'names': list(sent),
                'formats': [kind for kind, _ in sent.values()],
                'offsets': [offset for _, offset in sent.values()],
                'itemsize': step,
            }
        )
        rows = data[: height * row_step].reshape(height, row_step)[:, : width * step]
        raw = np.ascontiguousarray(rows).reshape(-1).view(as_sent)
        # NumPy warns when it widens a signalling NaN.
        with np.errstate(invalid='ignore'):
            for name in sent:
                points[name] = raw[name]
    return points


def _types_sent(
    msg: Any, layout: Layout, where: str
) -> dict[str, tuple[np.dtype[np.generic], int]]:
    """Type and offset in the message of each field of a layout that it has; all are checked."""
    order = '>' if msg.is_bigendian else '<'
    given = {str(f.name): f for f in msg.fields}
    if len(given) < len(msg.fields):
        raise LandmarkNavError(f'{where} has two fields of one name: its publisher is broken')
    sent: dict[str, tuple[np.dtype[np.generic], int]] = {}
    for name, kind, multiple in layout.columns():
        if name not in given:
            if not multiple and name not in layout.optional:
                raise LandmarkNavError(
                    f'{where} lacks the field {name} (it has {", ".join(given)!r:.60}): '
                    'publish it from landmark_nav'
                )
            continue
        # Some publishers leave the count of a scalar at 0.
        count, offset = max(1, int(given[name].count)), int(given[name].offset)
        scalar = np.dtype(order + _TYPES.get(int(given[name].datatype), 'V0'))
        wanted = max(1, int(np.prod(kind.shape)))
        if (
            (scalar.kind == 'f') != (kind.base.kind == 'f')
            or not scalar.itemsize
            or (count % multiple if multiple else count != wanted)
            or offset + count * scalar.itemsize > min(int(msg.point_step), _MAX_BYTES)
        ):
            raise LandmarkNavError(
                f'{where}: field {name} is {count} of type {scalar.name} at byte {offset} of '
                f'{msg.point_step}, not {multiple or wanted} of {kind.base.name}: '
                'publish it from landmark_nav'
            )
        sent[name] = np.dtype((scalar, (count,) if kind.shape else ())), offset
    return sent
