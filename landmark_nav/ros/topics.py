"""
The public topics: name, message, quality of service and former name, in one place.

Names are relative, so that namespaces and remappings apply. Publishers and subscriptions use the
same entry, so that they always match.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile

from landmark_nav.messages import encode
from landmark_nav.storage.bags.definitions import (
    DRIVE_IMAGES,
    MAP_TOPICS,
    SWEEP_IMAGES,
    TOPIC_TYPES,
)


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


SENSOR_DATA = qos_profile_sensor_data
# Profiles are reliable by default.
RELIABLE = QoSProfile(depth=10)
# Maps, by REP-2003: later subscribers get the last message.
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Learning needs several panoramas, so that one must not replace the one before.
PANORAMAS = QoSProfile(depth=8, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Deep enough for all frames of a sweep, if a bag delivers them at once.
SWEEP = QoSProfile(depth=400)


@dataclass(frozen=True)
class Topic:
    """Type and quality of service of a public topic."""

    type_name: str
    qos: QoSProfile

    @property
    def is_latched(self) -> bool:
        """Whether later subscribers get the last messages."""
        return self.qos.durability is DurabilityPolicy.TRANSIENT_LOCAL


PANORAMA_TOPICS = ('panorama/image', 'panorama/camera_info', 'panorama/pose')
_SENSOR_TOPICS = (
    *('joint_states', 'odom', 'ground_truth/odom', 'camera/camera_info', *DRIVE_IMAGES),
    'triangulation_localizer/debug_image/compressed',
)
# Profiles of the topics that are not RELIABLE.
_PROFILES = {
    **dict.fromkeys(_SENSOR_TOPICS, SENSOR_DATA),
    **dict.fromkeys((*SWEEP_IMAGES, 'sweep/camera_info'), SWEEP),
    **dict.fromkeys(PANORAMA_TOPICS, PANORAMAS),
    **dict.fromkeys(MAP_TOPICS, LATCHED),
}
TOPICS = {
    name: Topic(kind, _PROFILES.get(name, RELIABLE))
    for name, kind in TOPIC_TYPES.items()
    if not name.startswith('tf')
}
TOPICS['/clock'] = Topic('rosgraph_msgs/msg/Clock', SENSOR_DATA)
TOPICS['/diagnostics'] = Topic('diagnostic_msgs/msg/DiagnosticArray', RELIABLE)


# New name -> name in the last release.
FORMER_NAMES = {
    'global_localization/pose': 'found_place',
    '~/landmark_visibility': '~/standing',
    '~/triplet_scores': '~/ranking',
}


def publish_both(
    node: Node, publisher: Publisher[Any], former: Publisher[Any], warn: Callable[[str], None]
) -> None:
    """Make `publisher` publish at the former name, too, if a node subscribes only there."""
    publish, old, new = publisher.publish, former.topic_name, publisher.topic_name

    def publish_at_both(message: Any) -> None:
        publish(message)
        if former.get_subscription_count() and (
            who := _only_former(node.get_subscriptions_info_by_topic, old, new)
        ):
            former.publish(message)
            warn(_warning(who, 'subscribes to', old, new))

    publisher.publish = publish_at_both  # type: ignore[method-assign, assignment]


def hear_former(
    node: Node, topic: str, callback: Callable[[Any], None], warn: Callable[[str], None]
) -> Callable[[Any], None]:
    """Return the callback for the former name of a topic: for nodes that publish only there."""
    old, new = map(node.resolve_topic_name, (FORMER_NAMES[topic], topic))

    def take(message: Any) -> None:
        if who := _only_former(node.get_publishers_info_by_topic, old, new):
            warn(_warning(who, 'publishes', old, new))
            callback(message)

    return take


def _only_former(ends: Callable[[str], list[Any]], former: str, name: str) -> str:
    """First node with an endpoint at the former name and none at the new one, or ''."""
    old, new = (
        {f'{end.node_namespace.rstrip("/")}/{end.node_name}' for end in ends(topic)}
        for topic in (former, name)
    )
    return min(old - new, default='')


def _warning(who: str, does: str, former: str, name: str) -> str:
    return f'{who} {does} {former}, now called {name}: its old name ends with the next release'


class TransformBroadcaster:
    """
    Broadcasts transforms if tf2_msgs is installed (it is not part of the ROS wheels).

    A frame has one parent and one broadcaster: fusion sends ``map`` -> ``odom``; the robot, or the
    simulation, sends ``odom`` -> ``base_link`` and the frames of the pan-tilt unit.
    """

    def __init__(self, node: Node) -> None:
        self._moving: Publisher[Any] | None = None
        self._static: Publisher[Any] | None = None
        if find_spec('tf2_msgs') is not None:
            kind = message_class('tf2_msgs/msg/TFMessage')
            # Queue lengths as in tf2.
            self._moving = node.create_publisher(kind, '/tf', 100)
            self._static = node.create_publisher(kind, '/tf_static', LATCHED)

    def send(self, stamp_ns: int, moving: Iterable[encode.Transform]) -> None:
        """Send transforms of a time."""
        if self._moving is not None:
            self._moving.publish(encode.transforms(ros_factory, stamp_ns, moving))

    def send_static(self, stamp_ns: int, fixed: Iterable[encode.Transform]) -> None:
        """Send static transforms."""
        if self._static is not None:
            self._static.publish(encode.transforms(ros_factory, stamp_ns, fixed))
