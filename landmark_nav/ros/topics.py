"""
The public topics: name, type and quality of service, in one place.

Names are relative, so that namespaces and remappings apply. Publishers and subscriptions use the
same entry, so that they always match.
"""

from __future__ import annotations

from dataclasses import dataclass

from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    qos_profile_sensor_data,
    QoSProfile,
    ReliabilityPolicy,
)

from landmark_nav.storage.bags.topics import MAP_TOPICS, TOPIC_TYPES


def _reliable(depth: int, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


SENSOR_DATA = qos_profile_sensor_data
RELIABLE = _reliable(10, DurabilityPolicy.VOLATILE)
# Maps, by REP-2003: later subscribers get the last message.
LATCHED = _reliable(1, DurabilityPolicy.TRANSIENT_LOCAL)
# Learning needs several panoramas, so that one must not replace the one before.
PANORAMAS = _reliable(8, DurabilityPolicy.TRANSIENT_LOCAL)
# Deep enough for all frames of a sweep, if a bag delivers them at once.
SWEEP = _reliable(400, DurabilityPolicy.VOLATILE)


@dataclass(frozen=True)
class Topic:
    """Type and quality of service of a public topic."""

    type_name: str
    qos: QoSProfile


# Profiles of the topics that are not RELIABLE.
_PROFILES = {
    **dict.fromkeys(
        ('joint_states', 'odom', 'ground_truth/odom', 'camera/camera_info', 'camera/image_raw'),
        SENSOR_DATA,
    ),
    'camera/image_raw/compressed': SENSOR_DATA,
    'triangulation_localizer/debug_image/compressed': SENSOR_DATA,
    **dict.fromkeys(('sweep/image', 'sweep/image/compressed', 'sweep/camera_info'), SWEEP),
    **dict.fromkeys(('panorama/image', 'panorama/camera_info', 'panorama/pose'), PANORAMAS),
    **dict.fromkeys(MAP_TOPICS, LATCHED),
}
TOPICS = {
    name: Topic(kind, _PROFILES.get(name, RELIABLE))
    for name, kind in TOPIC_TYPES.items()
    if not name.startswith('tf')
}
TOPICS['/clock'] = Topic('rosgraph_msgs/msg/Clock', SENSOR_DATA)
TOPICS['/diagnostics'] = Topic('diagnostic_msgs/msg/DiagnosticArray', RELIABLE)


def with_depth(qos: QoSProfile, depth: int) -> QoSProfile:
    """Copy of a profile that keeps the last `depth` messages."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=qos.reliability,
        durability=qos.durability,
    )
