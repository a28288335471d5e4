"""
Types -> messages: the inverse of `landmark_nav.messages.decode`.

The first argument of every function is a `MessageFactory`: the same code builds messages of
rosbags for bags and ROS messages for topics.
"""

from landmark_nav.messages.encode.markers import (
    landmark_map,
    landmark_markers,
    pose_markers,
    view_markers,
)
from landmark_nav.messages.encode.poses import (
    camera_info,
    camera_transform,
    compressed_image,
    detections,
    expectation,
    global_pose,
    image,
    joint_state,
    joint_transforms,
    odometry,
    panorama,
    planar_transform,
    pose,
    pose_stamped,
    sweep_trajectory,
    Transform,
    transforms,
    triplet,
)
from landmark_nav.messages.factory import header
