"""The `MessageFactory` of ROS message classes."""

from __future__ import annotations

from array import array
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np


@cache
def message_class(type_name: str) -> Any:
    """Class of an interface by its full name, such as ``sensor_msgs/msg/Image``."""
    package, kind, name = type_name.split('/')
    return getattr(import_module(f'{package}.{kind}'), name)


@cache
def _field_types(type_name: str) -> dict[str, str]:
    return dict(message_class(type_name).get_fields_and_field_types())


def ros_factory(type_name: str, **fields: Any) -> Any:
    """
    Build a message of a type; omitted fields keep their defaults.

    NumPy arrays are copied into `array.array` for sequences: rclpy accepts that type without a
    check of every element.
    """
    kinds = _field_types(type_name)
    for name, value in fields.items():
        if isinstance(value, np.ndarray) and kinds.get(name, '').startswith('sequence'):
            sequence = array(value.dtype.char)
            sequence.frombytes(np.ascontiguousarray(value).tobytes())
            fields[name] = sequence
    return message_class(type_name)(**fields)
