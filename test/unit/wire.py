"""Messages as they arrive: out of a bag, and in the containers of rclpy."""

from __future__ import annotations

import array
from types import SimpleNamespace

import numpy as np
import pytest

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages.factory import default_typestore, rosbag_factory

STORE = default_typestore()
FACTORY = rosbag_factory()
MOUNT = PanTiltMount()
STAMP = 5_000_000_000_123


def over_the_wire(msg):
    """Serialise and read again, as a bag does."""
    return STORE.deserialize_cdr(STORE.serialize_cdr(msg, msg.__msgtype__), msg.__msgtype__)


def as_rclpy(msg):
    """The same fields in the containers that rclpy uses: array.array and lists."""
    if hasattr(msg, '__msgtype__'):
        fields = {k: as_rclpy(v) for k, v in vars(msg).items()}
        return SimpleNamespace(**fields)
    if isinstance(msg, list):
        return [as_rclpy(m) for m in msg]
    if isinstance(msg, np.ndarray):
        return array.array(msg.dtype.char.replace('?', 'B'), msg.tobytes())
    return msg


both = pytest.mark.parametrize('deliver', [over_the_wire, as_rclpy], ids=['rosbags', 'rclpy'])
