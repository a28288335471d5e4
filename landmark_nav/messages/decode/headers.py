"""Stamps, durations, frames, and checks of numbers, covariances and orientations."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.types import FloatArray

_SECOND_NS = 1_000_000_000
# Bound of any length, angle, rate or variance; publishers use smaller values for "unknown".
_MAX_VALUE = 1e12
# Largest delay of a clock, joint or camera.
_MAX_DELAY_S = 10.0
# Tolerance for rounding in a correlation matrix, whose diagonal is 1.
_ROUNDING = 1e-6


def stamp_ns(header: Any) -> int:
    """
    Stamp of a std_msgs/Header, integer nanoseconds.

    Raises `LandmarkNavError`: negative seconds, or nanoseconds outside of [0, 1e9).
    """
    sec, nanosec = _integer(header.stamp.sec), _integer(header.stamp.nanosec)
    if sec < 0 or not 0 <= nanosec < _SECOND_NS:
        raise LandmarkNavError(
            f'the stamp is {sec} s and {nanosec} ns, not a valid time: fix its publisher'
        )
    return sec * _SECOND_NS + nanosec


def is_unstamped(msg: Any) -> bool:
    """Whether a message has a header with a stamp of zero: its publisher does not set it."""
    header = getattr(msg, 'header', None)
    return header is not None and not (header.stamp.sec or header.stamp.nanosec)


def set_stamp(msg: Any, stamp_ns: int) -> None:
    """Set the stamp in the header of a message."""
    stamp = msg.header.stamp
    stamp.sec, stamp.nanosec = divmod(stamp_ns, 1_000_000_000)


def same_frame(frame: str, other: str) -> bool:
    """Whether two names mean the same frame; names of ROS 1 may begin with a slash."""
    return frame.lstrip('/') == other.lstrip('/')


def check_frame(header: Any, frame: str, remedy: str) -> None:
    """Raise `LandmarkNavError` with a `remedy` if a std_msgs/Header names another frame."""
    if not same_frame(header.frame_id, frame):
        raise LandmarkNavError(
            f'it is in frame {header.frame_id!r:.60}, not in frame {frame}: {remedy}'
        )


def duration_ns(value: Any) -> int:
    """
    Convert a builtin_interfaces Duration to integer nanoseconds.

    Raises `LandmarkNavError`: it is negative or not a number.
    """
    duration = _integer(value.sec) * _SECOND_NS + _integer(value.nanosec)
    if duration < 0:
        raise LandmarkNavError(f'time_from_start is {duration * 1e-9:.3f} s: count from the start')
    return duration


def finite(
    values: Any,
    what: str,
    stamp: int,
    within: float = _MAX_VALUE,
    *,
    least: float | None = None,
    count: int | None = None,
) -> FloatArray:
    """
    Return values of a field as an array of float64.

    A foreign definition of the message may have any type here. `what` and `stamp` [ns] are for the
    error; `least` is `-within` by default. Raises `LandmarkNavError`: a value is NaN, infinite,
    out of these bounds or not a number, or there are not `count`.
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
    least = -within if least is None else least
    good = (array >= least) & (array <= within)
    if not good.all():
        worst = float(array[~good][0])
        kind = f'not within {least:g} to {within:g}' if np.isfinite(worst) else 'not a number'
        raise LandmarkNavError(f'{where} is {worst:g}: {kind}, fix its publisher')
    return array


def delays_s(values: Any, what: str, stamp: int) -> list[float]:
    """Return delays, s, of either sign; `LandmarkNavError` if one is too large to be a delay."""
    return [float(value) for value in finite(values, what, stamp, _MAX_DELAY_S)]


def covariances(values: Any, what: str, stamp: int, size: int) -> FloatArray:
    """
    Return covariances (..., size, size), symmetric and positive semidefinite.

    Zero stands for "unknown" in some messages and for "exact" in others, so it is valid.

    Raises `LandmarkNavError`: a variance is negative, or a matrix is not symmetric or not positive
    semidefinite.
    """
    matrices = finite(values, what, stamp).reshape(-1, size, size)
    sigmas = np.sqrt(np.maximum(np.diagonal(matrices, axis1=1, axis2=2), 0.0))
    scale = np.maximum(sigmas[:, :, None] * sigmas[:, None, :], 1e-18)
    if np.diagonal(matrices, axis1=1, axis2=2).min(initial=0.0) < 0.0:
        why = 'has a negative variance'
    elif (np.abs(matrices - matrices.transpose(0, 2, 1)) > _ROUNDING * scale).any():
        why = 'is not symmetric'
    elif (
        np.linalg.eigvalsh(np.clip(matrices / scale, -_MAX_VALUE, _MAX_VALUE)).min(initial=0)
        < -_ROUNDING
    ):
        why = 'is not positive semidefinite'
    else:
        return matrices
    raise LandmarkNavError(f'{what} at {stamp * 1e-9:.3f} s {why}: fix its publisher')


def landmark_ids(
    ids: npt.NDArray[np.int64], what: str, unique: bool = True
) -> npt.NDArray[np.int64]:
    """Return ids of landmarks (n,); `LandmarkNavError` if one is negative or occurs twice."""
    if ids.min(initial=0) < 0 or (unique and len(np.unique(ids)) < len(ids)):
        raise LandmarkNavError(f'{what} names a landmark twice, or by a negative id')
    return ids


def yaw_rad(quaternion: Any, what: str, stamp: int) -> float:
    """
    Heading of a geometry_msgs/Quaternion, radians; it need not be exactly normalised.

    Raises `LandmarkNavError`: the quaternion is zero, or z is tilted by 90 degrees or more.
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


def _integer(value: Any) -> int:
    """Part of a time as an integer; a foreign definition of the message may have another type."""
    try:
        return int(value)
    except (TypeError, ValueError, OverflowError):
        raise LandmarkNavError(f'a time holds {value!r:.40}: fix its publisher') from None
