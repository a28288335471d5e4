"""Topics of the contract, in any namespace of a bag."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from landmark_nav.errors import LandmarkNavError

# Latched topics: a later subscriber receives the last message.
MAP_TOPICS = ('landmarks', 'landmarks/atlas', 'landmarks/markers')

# Greatest number of names in a message.
_MOST_NAMES = 5

# Type -> topics.
_BY_TYPE = {
    'sensor_msgs/msg/Image': 'camera/image_raw sweep/image panorama/image landmarks/atlas',
    'sensor_msgs/msg/CompressedImage': 'camera/image_raw/compressed sweep/image/compressed '
    'triangulation_localizer/debug_image/compressed',
    'sensor_msgs/msg/CameraInfo': 'camera/camera_info sweep/camera_info panorama/camera_info',
    'sensor_msgs/msg/JointState': 'joint_states',
    'sensor_msgs/msg/PointCloud2': 'landmarks triplet detections global_localization/pose '
    'expectation',
    'nav_msgs/msg/Odometry': 'odom ground_truth/odom odometry/fused',
    'nav_msgs/msg/Path': 'odometry_fusion/path odometry_fusion/odometry_path',
    'trajectory_msgs/msg/JointTrajectory': 'pan_tilt/command sweep/trajectory',
    'geometry_msgs/msg/PoseWithCovarianceStamped': 'sweep/pose panorama/pose triangulation/pose '
    'initialpose odometry_fusion/protection_level',
    'geometry_msgs/msg/Twist': 'cmd_vel',
    'visualization_msgs/msg/MarkerArray': 'landmarks/markers odometry_fusion/markers '
    'triangulation_localizer/markers',
    'tf2_msgs/msg/TFMessage': 'tf tf_static',
}
TOPIC_TYPES = {topic: kind for kind, topics in _BY_TYPE.items() for topic in topics.split()}


def relative_name(topic: str) -> str:
    """
    Return the longest name in the contract that a topic ends with; else the topic itself.

    ``/robot1/odom`` is ``odom``, ``/ground_truth/odom`` is not.
    """
    topic = _normal(topic)
    ends = [name for name in TOPIC_TYPES if topic.endswith('/' + name)]
    return max(ends, key=len) if ends else topic[1:]


def find_topic(
    name: str, types: Mapping[str, str], given: Mapping[str, str] | None = None
) -> str | None:
    """
    Return the topic of a bag that the contract calls `name`; None if there is none.

    `given` are topics of the bag by names in the contract, by the user. The type of an image topic
    decides whether it is raw or compressed, not the given name. Raises `LandmarkNavError`: the
    topic is ambiguous, has another type, or the given one is not in the bag.
    """
    topics = {_normal(topic): topic for topic in types}
    by_user = {
        _with_form(key, types.get(topics.get(_normal(topic), ''), '')): _normal(topic)
        for key, topic in (given or {}).items()
    }
    if name in by_user:
        found = [topics[by_user[name]]] if by_user[name] in topics else []
        if not found:
            raise LandmarkNavError(
                f'--topic {name}={by_user[name]}: not in the bag; there are {listed(topics)}'
            )
    else:
        found = [
            topics[t] for t in topics if relative_name(t) == name and t not in by_user.values()
        ]
    if len(found) > 1 and f'/{name}' in topics:
        found = [topics[f'/{name}']]
    if len(found) > 1:
        found = [topic for topic in found if types[topic] == TOPIC_TYPES[name]] or found
    if len(found) > 1:
        raise LandmarkNavError(
            f'several topics could be {name} ({listed(found)}): say which by --topic '
            f'{name}={sorted(found)[0]}'
        )
    if not found:
        return None
    if types[found[0]] != TOPIC_TYPES[name]:
        raise LandmarkNavError(
            f'topic {found[0]} is of type {types[found[0]]}, not {TOPIC_TYPES[name]}'
        )
    return found[0]


def remedy_of_missing(names: Iterable[str], types: Mapping[str, str]) -> str:
    """Advice if no topic has one of `names`; it lists unknown topics of a matching type."""
    others = sorted(topic for topic in types if relative_name(topic) not in TOPIC_TYPES)
    choices = [
        f'--topic {name}={topic}'
        for name in names
        for topic in others
        if types[topic] == TOPIC_TYPES[name]
    ]
    return f'record it, or give {" or ".join(choices[:2])}' if choices else 'record it'


def listed(names: Iterable[str]) -> str:
    """Names in a line; of many only the first."""
    ordered = sorted(names)
    more = f' and {len(ordered) - _MOST_NAMES} more' if len(ordered) > _MOST_NAMES else ''
    return ', '.join(ordered[:_MOST_NAMES]) + more


def _normal(topic: str) -> str:
    """Absolute topic without repeated or trailing slashes."""
    return '/' + '/'.join(part for part in topic.split('/') if part)


def _with_form(name: str, type_name: str) -> str:
    """Name in the contract by the type: images have one name raw, another compressed."""
    base = name.removesuffix('/compressed')
    forms = {
        TOPIC_TYPES[form]: form for form in (base, f'{base}/compressed') if form in TOPIC_TYPES
    }
    return forms.get(type_name, name)
