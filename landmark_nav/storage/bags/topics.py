"""The topics of the contract, whatever namespace a bag was recorded under."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from landmark_nav.errors import LandmarkNavError

# Latched: who comes later still gets the last one.
MAP_TOPICS = ('landmarks', 'landmarks/atlas', 'landmarks/markers')

# A line for people has room for so many names.
_MOST_NAMES = 5

TOPIC_TYPES = {
    'camera/image_raw': 'sensor_msgs/msg/Image',
    'camera/image_raw/compressed': 'sensor_msgs/msg/CompressedImage',
    'camera/camera_info': 'sensor_msgs/msg/CameraInfo',
    'joint_states': 'sensor_msgs/msg/JointState',
    'odom': 'nav_msgs/msg/Odometry',
    'ground_truth/odom': 'nav_msgs/msg/Odometry',
    'pan_tilt/command': 'trajectory_msgs/msg/JointTrajectory',
    'sweep/image': 'sensor_msgs/msg/Image',
    'sweep/image/compressed': 'sensor_msgs/msg/CompressedImage',
    'sweep/camera_info': 'sensor_msgs/msg/CameraInfo',
    'sweep/trajectory': 'trajectory_msgs/msg/JointTrajectory',
    'sweep/pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'panorama/image': 'sensor_msgs/msg/Image',
    'panorama/camera_info': 'sensor_msgs/msg/CameraInfo',
    'panorama/pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'landmarks': 'sensor_msgs/msg/PointCloud2',
    'landmarks/atlas': 'sensor_msgs/msg/Image',
    'landmarks/markers': 'visualization_msgs/msg/MarkerArray',
    'triplet': 'sensor_msgs/msg/PointCloud2',
    'detections': 'sensor_msgs/msg/PointCloud2',
    'triangulation/pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'cmd_vel': 'geometry_msgs/msg/Twist',
    'initialpose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'global_localization/pose': 'sensor_msgs/msg/PointCloud2',
    'odometry/fused': 'nav_msgs/msg/Odometry',
    'odometry_fusion/protection_level': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'odometry_fusion/path': 'nav_msgs/msg/Path',
    'odometry_fusion/odometry_path': 'nav_msgs/msg/Path',
    'odometry_fusion/markers': 'visualization_msgs/msg/MarkerArray',
    'triangulation_localizer/markers': 'visualization_msgs/msg/MarkerArray',
    'triangulation_localizer/debug_image/compressed': 'sensor_msgs/msg/CompressedImage',
    'expectation': 'sensor_msgs/msg/PointCloud2',
    'tf': 'tf2_msgs/msg/TFMessage',
    'tf_static': 'tf2_msgs/msg/TFMessage',
}


def relative_name(topic: str) -> str:
    """
    Name in the contract of a bag's topic: the longest one that it ends with; else itself.

    ``/robot1/odom`` is ``odom``, ``/ground_truth/odom`` is not.
    """
    topic = _normal(topic)
    ends = [name for name in TOPIC_TYPES if topic.endswith('/' + name)]
    return max(ends, key=len) if ends else topic[1:]


def find_topic(
    name: str, types: Mapping[str, str], given: Mapping[str, str] | None = None
) -> str | None:
    """
    Topic of a bag that carries what the contract calls `name`; None if there is none.

    Raises `LandmarkNavError`: several could be it, it is of another type, or the one that is given
    is not there.

    Parameters
    ----------
    name : str
        Relative name, such as ``camera/camera_info``.
    types : mapping
        Topics of the bag and their types.
    given : mapping, optional
        Topics by their names in the contract, as the user gives them. An image is raw or
        compressed by its type, whichever name it is given for.
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
    """What to do where none of `names` is among topics: those that could be it are named."""
    others = sorted(topic for topic in types if relative_name(topic) not in TOPIC_TYPES)
    choices = [
        f'--topic {name}={topic}'
        for name in names
        for topic in others
        if types[topic] == TOPIC_TYPES[name]
    ]
    return f'record it, or give {" or ".join(choices[:2])}' if choices else 'record it'


def listed(names: Iterable[str]) -> str:
    """Names in a line, some of them if they are many."""
    ordered = sorted(names)
    more = f' and {len(ordered) - _MOST_NAMES} more' if len(ordered) > _MOST_NAMES else ''
    return ', '.join(ordered[:_MOST_NAMES]) + more


def _normal(topic: str) -> str:
    """Topic with one slash before each part of its name."""
    return '/' + '/'.join(part for part in topic.split('/') if part)


def _with_form(name: str, type_name: str) -> str:
    """Name in the contract of what is of a type: images have one for each form."""
    base = name.removesuffix('/compressed')
    forms = {
        TOPIC_TYPES[form]: form for form in (base, f'{base}/compressed') if form in TOPIC_TYPES
    }
    return forms.get(type_name, name)
