"""Stamps, and numbers that must be numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.types import FloatArray

__all__ = [
    'check_frame',
    'duration_ns',
    'finite',
    'is_unstamped',
    'same_frame',
    'set_stamp',
    'stamp_ns',
    'yaw_rad',
]


def stamp_ns(header: Any) -> int:
    """Stamp of a std_msgs/Header, integer nanoseconds."""
    return duration_ns(header.stamp)


def is_unstamped(msg: Any) -> bool:
    """Whether a message has a header whose stamp is zero: its publisher does not stamp."""
    header = getattr(msg, 'header', None)
    return header is not None and not (header.stamp.sec or header.stamp.nanosec)


def set_stamp(msg: Any, stamp_ns: int) -> None:
    """Stamp the header of a message."""
    stamp = msg.header.stamp
    stamp.sec, stamp.nanosec = divmod(stamp_ns, 1_000_000_000)


def same_frame(frame: str, other: str) -> bool:
    """Whether two names are of one frame; those of ROS 1 may begin with a slash."""
    return frame.lstrip('/') == other.lstrip('/')


def check_frame(header: Any, frame: str, remedy: str) -> None:
    """`LandmarkNavError` where a std_msgs/Header names another frame, with what to do then."""
    if not same_frame(header.frame_id, frame):
        raise LandmarkNavError(
            f'it is in frame {header.frame_id!r}, not in frame {frame}: {remedy}'
        )


def duration_ns(value: Any) -> int:
    """Convert a builtin_interfaces Time or Duration to integer nanoseconds."""
    return int(value.sec) * 1_000_000_000 + int(value.nanosec)


def finite(values: Any, what: str, stamp: int) -> FloatArray:
    """
    Values as an array; a `LandmarkNavError` that says which are none if one is NaN or infinite.

    `what` names them: 'odometry position'; `stamp` is when, nanoseconds.
    """
    array = np.asarray(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise LandmarkNavError(
            f'{what} at {stamp * 1e-9:.3f} s is {np.array2string(array, separator=", ")}: '
            'not a number, mend its publisher'
        )
    return array


def yaw_rad(quaternion: Any, what: str, stamp: int) -> float:
    """
    Heading of a geometry_msgs/Quaternion, radians; it need not be normalised exactly.

    A `LandmarkNavError` says so where there is none: zero, or over on its side or its head.
    """
    turn = [quaternion.x, quaternion.y, quaternion.z, quaternion.w]
    x, y, z, w = finite(turn, what, stamp).tolist()
    if x * x + y * y + z * z + w * w < 1e-6:
        raise LandmarkNavError(f'{what} at {stamp * 1e-9:.3f} s is the zero quaternion')
    if x * x + y * y >= w * w + z * z:
        raise LandmarkNavError(
            f'{what} at {stamp * 1e-9:.3f} s is ({x:.2f}, {y:.2f}, {z:.2f}, {w:.2f}): '
            'fallen over, its z must point up'
        )
    return float(np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z))
