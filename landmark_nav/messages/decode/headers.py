"""Stamps, frames, and checks of numbers, covariances and orientations."""

from __future__ import annotations

from math import isqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.messages.clouds import Layout, MAX_VALUE, unpack_cloud
from landmark_nav.types import FloatArray

# Tolerance for rounding in a correlation matrix, whose diagonal is 1.
_ROUNDING = 1e-6


def time_ns(value: Any) -> int:
    """Convert a builtin_interfaces Time or Duration, not negative, to integer nanoseconds."""
    try:
        sec, nanosec = int(value.sec), int(value.nanosec)
    except (TypeError, ValueError, OverflowError):
        # A foreign definition of the message may have another type.
        raise LandmarkNavError(f'a time holds {value.sec!r:.40}: fix its publisher') from None
    if sec < 0 or not 0 <= nanosec < 10**9:
        raise LandmarkNavError(
            f'a time is {sec} s and {nanosec} ns, which is not valid: fix its publisher'
        )
    return sec * 10**9 + nanosec


def stamp_ns(header: Any) -> int:
    """Stamp of a std_msgs/Header, integer nanoseconds."""
    return time_ns(header.stamp)


def is_unstamped(msg: Any) -> bool:
    """Whether a message has a header with a stamp of zero: its publisher does not set it."""
    header = getattr(msg, 'header', None)
    return header is not None and not (header.stamp.sec or header.stamp.nanosec)


def set_stamp(msg: Any, stamp_ns: int) -> None:
    """Set the stamp in the header of a message."""
    msg.header.stamp.sec, msg.header.stamp.nanosec = divmod(stamp_ns, 10**9)


def same_frame(frame: str, other: str) -> bool:
    """Whether two names mean the same frame; names of ROS 1 may begin with a slash."""
    return frame.lstrip('/') == other.lstrip('/')


def check_frame(header: Any, frame: str, remedy: str) -> None:
    """Raise `LandmarkNavError` with a `remedy` if a std_msgs/Header names another frame."""
    if not same_frame(header.frame_id, frame):
        raise LandmarkNavError(
            f'it is in frame {header.frame_id!r:.60}, not in frame {frame}: {remedy}'
        )


def finite(
    values: Any,
    what: str,
    stamp: int,
    most: float = MAX_VALUE,
    *,
    least: float | None = None,
    count: int | None = None,
) -> FloatArray:
    """
    Return values of a field as an array of float64.

    A foreign definition of the message may have any type here. `what` and `stamp` [ns] are for the
    error; `least` is `-most` by default. Raises `LandmarkNavError`: a value is NaN, infinite, out
    of these bounds or not a number, or there are not `count`.
    """
    where = f'{what} at {stamp * 1e-9:.3f} s'
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise LandmarkNavError(
            f'{where} is {values!r:.40}: not a number, fix its publisher'
        ) from None
    if count is not None and array.size != count:
        raise LandmarkNavError(f'{where} has {array.size} values, not {count}')
    least = -most if least is None else least
    good = (array >= least) & (array <= most)
    if not good.all():
        worst = float(array[~good][0])
        kind = f'not within {least:g} to {most:g}' if np.isfinite(worst) else 'not a number'
        raise LandmarkNavError(f'{where} is {worst:g}: {kind}, fix its publisher')
    return array


def covariances(values: Any, what: str, stamp: int, size: int) -> FloatArray:
    """
    Return covariances (..., size, size), symmetric and positive semidefinite.

    Zero stands for "unknown" in some messages and for "exact" in others, so it is valid.
    """
    matrices = finite(values, what, stamp).reshape(-1, size, size)
    variances = np.diagonal(matrices, axis1=1, axis2=2)
    sigmas = np.sqrt(np.maximum(variances, 0.0))
    scale = np.maximum(sigmas[:, :, None] * sigmas[:, None, :], 1e-18)
    correlations = np.clip(matrices / scale, -MAX_VALUE, MAX_VALUE)
    if variances.min(initial=0.0) < 0.0:
        why = 'has a negative variance'
    elif (np.abs(correlations - correlations.transpose(0, 2, 1)) > _ROUNDING).any():
        why = 'is not symmetric'
    elif np.linalg.eigvalsh(correlations).min(initial=0.0) < -_ROUNDING:
        why = 'is not positive semidefinite'
    else:
        return matrices
    raise LandmarkNavError(f'{what} at {stamp * 1e-9:.3f} s {why}: fix its publisher')


def nonzero(values: FloatArray) -> FloatArray | None:
    """Return values; None if all are zero, which stands for unknown."""
    return values if values.any() else None


class Points:
    """The points of a PointCloud2 in a layout; fields are checked when they are read."""

    def __init__(self, msg: Any, layout: Layout) -> None:
        self.layout, self.raw = layout, unpack_cloud(msg, layout)
        self.stamp = stamp_ns(msg.header)

    def __len__(self) -> int:
        return len(self.raw)

    def __call__(self, *names: str, rows: Any = slice(None)) -> FloatArray:
        """
        Values of a field, (n, ...), or of several side by side, within the bounds of the first.

        Fields named ``covariance`` are matrices.
        """
        first = names[0]
        what, found = f'{self.layout.topic} {first}', self.raw[first][rows]
        if first.endswith('covariance'):
            return covariances(found, what, self.stamp, isqrt(found.shape[1]))
        if len(names) > 1:
            found = np.stack([self.raw[name][rows] for name in names], -1)
        least, most = self.layout.bounds[first]
        return finite(found, what, self.stamp, most, least=least)

    def common(self) -> dict[str, Any]:
        """Values of the common fields by attribute; zero without points. Raises as above."""
        # A sum over one row or none.
        return {
            self.layout.attributes[name]: self(name, rows=slice(1)).sum(0)
            for name in self.layout.common
        }

    def ids(self, unique: bool = True) -> npt.NDArray[np.int64]:
        """Ids of landmarks (n,); `LandmarkNavError` if one is negative or occurs twice."""
        ids = np.asarray(self.raw['id'], dtype=np.int64)
        if ids.min(initial=0) < 0 or (unique and len(np.unique(ids)) < len(ids)):
            raise LandmarkNavError(
                f'{self.layout.topic} names a landmark twice, or by a negative id'
            )
        return ids


def yaw_rad(quaternion: Any, what: str, stamp: int) -> float:
    """
    Heading of a geometry_msgs/Quaternion, radians; it need not be exactly normalised.

    A rotation that tilts z by 90 degrees or more is an error.
    """
    turn = [quaternion.x, quaternion.y, quaternion.z, quaternion.w]
    x, y, z, w = finite(turn, what, stamp, count=4).tolist()
    if x * x + y * y + z * z + w * w < 1e-6:
        raise LandmarkNavError(f'{what} at {stamp * 1e-9:.3f} s is the zero quaternion: set it')
    if x * x + y * y >= w * w + z * z:
        raise LandmarkNavError(
            f'{what} at {stamp * 1e-9:.3f} s is ({x:.2g}, {y:.2g}, {z:.2g}, {w:.2g}): '
            'fallen over, its z must point up'
        )
    return float(np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z))
