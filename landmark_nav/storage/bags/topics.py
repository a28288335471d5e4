"""The topics of the contract, whatever namespace a bag was recorded under."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from landmark_nav.errors import LandmarkNavError

__all__ = ['TOPIC_TYPES', 'find_topic', 'relative_name', 'remedy_of_missing']

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
    'found_place': 'sensor_msgs/msg/PointCloud2',
    'odometry/fused': 'nav_msgs/msg/Odometry',
    'joint_delay': 'sensor_msgs/msg/PointCloud2',
}


def relative_name(topic: str) -> str:
    """
    Name in the contract of a bag's topic: the longest one that it ends with; else itself.

    ``/robot1/odom`` is ``odom``, ``/ground_truth/odom`` is not.
    """
    ends = [name for name in TOPIC_TYPES if topic == name or topic.endswith('/' + name)]
    return max(ends, key=len) if ends else topic.lstrip('/')


def find_topic(name: str, types: Mapping[str, str]) -> str | None:
    """
    Topic of a bag that carries what the contract calls `name`; None if there is none.

    Parameters
    ----------
    name : str
        Relative name, such as ``camera/camera_info``.
    types : mapping
        Topics of the bag and their types.

    Raises
    ------
    LandmarkNavError
        Several could be it, or it is of another type.

    """
    found = [topic for topic in types if relative_name(topic) == name]
    if f'/{name}' in found:
        found = [f'/{name}']
    if len(found) > 1:
        raise LandmarkNavError(
            f'several topics could be {name} ({_listed(found)}): keep one of them, that of the '
            f'robot and sensor that are meant, or rename it to /{name}'
        )
    if not found:
        return None
    if types[found[0]] != TOPIC_TYPES[name]:
        raise LandmarkNavError(
            f'topic {found[0]} is of type {types[found[0]]}, not {TOPIC_TYPES[name]}'
        )
    return found[0]


def remedy_of_missing(names: Iterable[str], types: Mapping[str, str]) -> str:
    """What to do where none of `names` is among topics: what could be it is told."""
    others = sorted(topic for topic in types if relative_name(topic) not in TOPIC_TYPES)
    renames = [
        f'{topic} to {name}'
        for name in names
        for topic in others
        if types[topic] == TOPIC_TYPES[name]
    ]
    if not renames:
        return 'record it'
    return (
        f'record it, or, if that is it, rename {" or ".join(renames)} '
        '(remap it before it is recorded, or rewrite the bag)'
    )


def _listed(names: Iterable[str]) -> str:
    return ', '.join(sorted(names))
