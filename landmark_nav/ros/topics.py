"""
The public topics: name, type and quality of service, in one place.

Names are relative, so that a namespace or a remapping moves them. Both ends of a topic take its
entry from here, hence they always match.
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

__all__ = ['LATCHED', 'RELIABLE', 'SENSOR_DATA', 'SWEEP', 'TOPICS', 'Topic', 'with_depth']


def _reliable(depth: int, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


SENSOR_DATA = qos_profile_sensor_data
RELIABLE = _reliable(10, DurabilityPolicy.VOLATILE)
# REP-2003 for maps: who comes later still gets the last one.
LATCHED = _reliable(1, DurabilityPolicy.TRANSIENT_LOCAL)
# Deep enough for all frames of a sweep, should a bag deliver them at once.
SWEEP = _reliable(400, DurabilityPolicy.VOLATILE)


@dataclass(frozen=True)
class Topic:
    """Type and quality of service of a public topic."""

    type_name: str
    qos: QoSProfile


_POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'

TOPICS = {
    'camera/image_raw': Topic('sensor_msgs/msg/Image', SENSOR_DATA),
    'camera/image_raw/compressed': Topic('sensor_msgs/msg/CompressedImage', SENSOR_DATA),
    'camera/camera_info': Topic('sensor_msgs/msg/CameraInfo', SENSOR_DATA),
    'joint_states': Topic('sensor_msgs/msg/JointState', SENSOR_DATA),
    'odom': Topic('nav_msgs/msg/Odometry', SENSOR_DATA),
    'ground_truth/odom': Topic('nav_msgs/msg/Odometry', SENSOR_DATA),
    'sweep/image': Topic('sensor_msgs/msg/Image', SWEEP),
    'sweep/image/compressed': Topic('sensor_msgs/msg/CompressedImage', SWEEP),
    'sweep/camera_info': Topic('sensor_msgs/msg/CameraInfo', SWEEP),
    'sweep/trajectory': Topic('trajectory_msgs/msg/JointTrajectory', RELIABLE),
    'sweep/pose': Topic(_POSE, RELIABLE),
    'panorama/image': Topic('sensor_msgs/msg/Image', LATCHED),
    'panorama/camera_info': Topic('sensor_msgs/msg/CameraInfo', LATCHED),
    'panorama/pose': Topic(_POSE, LATCHED),
    'landmarks': Topic('sensor_msgs/msg/PointCloud2', LATCHED),
    'landmarks/atlas': Topic('sensor_msgs/msg/Image', LATCHED),
    'landmarks/markers': Topic('visualization_msgs/msg/MarkerArray', LATCHED),
    'triplet': Topic('sensor_msgs/msg/PointCloud2', RELIABLE),
    'detections': Topic('sensor_msgs/msg/PointCloud2', RELIABLE),
    'triangulation/pose': Topic(_POSE, RELIABLE),
    'cmd_vel': Topic('geometry_msgs/msg/Twist', RELIABLE),
    'initialpose': Topic(_POSE, RELIABLE),
    'odometry/fused': Topic('nav_msgs/msg/Odometry', RELIABLE),
    '/diagnostics': Topic('diagnostic_msgs/msg/DiagnosticArray', RELIABLE),
}


def with_depth(qos: QoSProfile, depth: int) -> QoSProfile:
    """Copy of a profile that keeps the last `depth` messages."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=qos.reliability,
        durability=qos.durability,
    )
