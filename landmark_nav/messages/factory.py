"""Factories of messages: those of rosbags here, those of ROS classes in `landmark_nav.ros`."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore


class MessageFactory(Protocol):
    """
    Builds a message by its type name, such as ``geometry_msgs/msg/Pose``.

    Omitted fields have the defaults of ROS. Numeric arrays are one-dimensional NumPy arrays of the
    field's element type, whether their length is fixed or not. A factory for classes that need
    another type converts them (``array.array`` for ``uint8[]``: rclpy checks every element of
    other types).
    """

    def __call__(self, type_name: str, **fields: Any) -> Any:
        """Return the message."""


def default_typestore() -> Typestore:
    """Return the standard message types that this package reads and writes."""
    return get_typestore(Stores.ROS2_JAZZY)


def rosbag_factory() -> MessageFactory:
    """Return a factory of messages that rosbags serialises."""
    store = default_typestore()

    def build(type_name: str, **fields: Any) -> Any:
        _, definitions = store.fielddefs[type_name]
        unknown = fields.keys() - {name for name, _ in definitions}
        if unknown:
            raise TypeError(f'{type_name} has no field {", ".join(sorted(unknown))}')
        for name, description in definitions:
            if name not in fields:
                fields[name] = default(description)
        if type_name == 'geometry_msgs/msg/Quaternion' and not any(fields.values()):
            fields['w'] = 1.0
        return store.types[type_name](**fields)

    def default(description: Any) -> Any:
        kind, content = description
        if kind == Nodetype.NAME:
            return build(content)
        if kind == Nodetype.BASE:
            return '' if content[0] == 'string' else _scalar_type(content[0])().item()
        element, length = content
        if element[0] == Nodetype.BASE and element[1][0] != 'string':
            count = length if kind == Nodetype.ARRAY else 0
            return np.zeros(count, dtype=_scalar_type(element[1][0]))
        return [default(element) for _ in range(length if kind == Nodetype.ARRAY else 0)]

    return build


def _scalar_type(name: str) -> Any:
    return {'bool': np.bool_, 'byte': np.uint8, 'char': np.uint8}.get(name) or getattr(np, name)
