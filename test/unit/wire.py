"""Messages as received: from a bag, and in the containers of rclpy."""

import array
from dataclasses import fields, is_dataclass
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


def assert_same(one, other, rtol=0.0):
    """Two objects of any dataclasses hold the same, numbers to a relative tolerance."""
    if is_dataclass(one):
        assert type(one) is type(other)
        one, other = ([getattr(k, f.name) for f in fields(k)] for k in (one, other))
    if isinstance(one, tuple | list):
        for part, counterpart in zip(one, other, strict=True):
            assert_same(part, counterpart, rtol)
    elif isinstance(one, np.ndarray | float):
        np.testing.assert_allclose(one, other, rtol=rtol, atol=rtol)
    else:
        assert one == other


both = pytest.mark.parametrize('deliver', [over_the_wire, as_rclpy], ids=['rosbags', 'rclpy'])
