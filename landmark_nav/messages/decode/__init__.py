"""
Messages -> types.

Every function takes objects that have the fields of the message, so that the same code serves
rosbags and rclpy; numeric arrays may be NumPy arrays, array.array, bytes or lists.
"""

from landmark_nav.messages.decode.cameras import camera_info, camera_model, CameraInfo
from landmark_nav.messages.decode.detections import detections, triplet
from landmark_nav.messages.decode.headers import check_frame, stamp_ns
from landmark_nav.messages.decode.images import BitDepth, camera_image, image
from landmark_nav.messages.decode.joints import (
    joint_delay,
    joint_sample,
    lone_tilt,
    sweep_trajectory,
)
from landmark_nav.messages.decode.landmarks import landmark_map
from landmark_nav.messages.decode.panoramas import panorama
from landmark_nav.messages.decode.poses import found_place, odometry, pose_estimate

__all__ = [
    'BitDepth',
    'CameraInfo',
    'camera_image',
    'camera_info',
    'camera_model',
    'check_frame',
    'detections',
    'found_place',
    'image',
    'joint_delay',
    'joint_sample',
    'landmark_map',
    'lone_tilt',
    'odometry',
    'panorama',
    'pose_estimate',
    'stamp_ns',
    'sweep_trajectory',
    'triplet',
]
