"""
Messages -> types.

Every function accepts any object with the fields of the message, from rosbags or rclpy. Numeric
arrays may be NumPy arrays, array.array, bytes or lists. It raises `LandmarkNavError` if a field is
missing or of another type, or a value is not a number or not within its bounds.
"""

from landmark_nav.messages.decode.headers import (
    check_frame,
    is_unstamped,
    same_frame,
    set_stamp,
    stamp_ns,
)
from landmark_nav.messages.decode.images import (
    BitDepth,
    camera_image,
    camera_info,
    camera_model,
    CameraInfo,
    image,
    published_size,
)
from landmark_nav.messages.decode.joints import (
    joint_angles,
    JointNames,
    matching_name,
    sweep_trajectory,
)
from landmark_nav.messages.decode.landmarks import landmark_map
from landmark_nav.messages.decode.poses import (
    detections,
    expectation,
    global_pose,
    odometry,
    panorama,
    pose_estimate,
    triplet,
)
