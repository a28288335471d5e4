"""Valid inputs to start from: a small room, its map, a message of each topic."""

from functools import cache
from typing import Any

from builders import bare_landmark
import numpy as np

from landmark_nav.calibration import Calibration
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.messages import encode
from landmark_nav.messages.clouds import GlobalPose
from landmark_nav.messages.factory import rosbag_factory
from landmark_nav.types import (
    Detections,
    Expectation,
    JointSample,
    LandmarkMap,
    OdometrySample,
    Panorama,
    PoseEstimate,
    Triplet,
)

SECOND_NS = 1_000_000_000
CAMERA = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)

_CORNERS = {'south': (0.0, 0.0), 'east': (4.0, 0.0), 'north': (4.0, 3.0), 'west': (0.0, 3.0)}
ROOM_YAML: dict[str, Any] = {
    'frame_id': 'map',
    'walls': [
        {'id': name, 'start': list(start), 'end': list(end), 'height': 2.5}
        for (name, start), end in zip(
            _CORNERS.items(), np.roll(list(_CORNERS.values()), -1, 0).tolist(), strict=True
        )
    ],
    'reference_area': {
        'papers': [
            {'color': colour, 'center': [x, 0.0, 1.1], 'width': 0.21, 'height': 0.297}
            for colour, x in (('red', 1.0), ('green', 2.0), ('blue', 3.2))
        ]
    },
}
ROBOT_YAML: dict[str, Any] = {
    'pan_axis': {'xyz': [0.08, 0.0, 1.1], 'rpy': [0.0, 0.0, 0.0]},
    'optical_center_offset': [0.01, 0.0, 0.0],
    'camera_roll': 0.0,
    'pan_sigma': 0.0002,
    'base_frame': 'base_link',
    'pan_joint': 'pan_joint',
    'tilt_joint': 'tilt_joint',
}
MOUNT = PanTiltMount((0.08, 0.0, 1.1), optical_center_offset=(0.01, 0.0, 0.0), pan_sigma_rad=2e-4)


def landmark_map(count=6):
    """Landmarks on the south wall of the room."""
    rng = np.random.default_rng(0)
    landmarks = tuple(
        bare_landmark(
            k, np.array([0.5 + 0.6 * k, 0.0, 1.1]), np.diag([1e-4, 1e-5, 1e-4]),
            normal=np.array([0.0, 1.0, 0.0]), height_m=0.15,
            patch=rng.integers(0, 255, (15, 20), dtype=np.uint8),
            viewpoint=np.array([2.0, 1.5, 1.1]), wall_id='south',
        )
        for k in range(count)
    )  # fmt: skip
    return LandmarkMap(landmarks)


@cache
def recorded():
    """Messages as a bag holds them."""
    return messages(rosbag_factory())


def messages(make, stamp_ns=10 * SECOND_NS):
    """Valid message of each topic that some node or a bag reads, by topic, of one stamp."""
    rng = np.random.default_rng(1)
    image = rng.integers(0, 255, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    pose = PoseEstimate(stamp_ns, np.array([2.0, 1.5, -1.5]), np.diag([1e-3, 1e-3, 1e-3]))
    sample = OdometrySample(stamp_ns, np.array([2.0, 1.5, -1.5]), 0.2, 0.1)
    joints = JointSample(stamp_ns, 0.1)
    bearings = np.array([-0.4, 0.0, 0.5])
    found = Detections(
        stamp_ns, np.arange(3), bearings, np.full(3, 1e-6), np.full(3, 0.9), np.full((3, 2), 20.0),
        np.array([4]), points=np.column_stack([-np.tan(bearings), np.zeros(3)]),
        point_covariance=np.tile(1e-6 * np.eye(2), (3, 1, 1)),
    )  # fmt: skip
    calibration = Calibration.of_mount(MOUNT)
    expected = Expectation(stamp_ns, pose.pose, pose.covariance, calibration, 0.01)
    triplet = Triplet(stamp_ns, np.arange(3), bearings, np.full(3, 1e-3), np.eye(3) * 1e-4, 0.1)
    place = GlobalPose(stamp_ns, pose.pose, pose.covariance, np.arange(3))
    cylinder = Cylinder(64, 16, 10.2, 31.5, 7.5)
    panorama = Panorama(
        stamp_ns, np.ascontiguousarray(image[:16]), np.ones((16, 64), dtype=np.bool_), cylinder,
        np.array([2.0, 1.5, 1.1]), 0.0, np.eye(4) * 1e-4,
    )  # fmt: skip
    points, atlas, _ = encode.landmark_map(make, landmark_map(), stamp_ns)
    panorama_image, panorama_info, panorama_pose = encode.panorama(make, panorama)
    frames = tuple(
        JointSample(stamp_ns + k * SECOND_NS // 10, pan)
        for k, pan in enumerate(np.linspace(-3.0, 3.0, 12))
    )
    camera_info = encode.camera_info(make, CAMERA, stamp_ns, 'camera_optical_frame')
    raw = encode.image(make, image, stamp_ns, 'camera_optical_frame')
    compressed = encode.compressed_image(make, image, stamp_ns, 'camera_optical_frame')
    return {
        'camera/image_raw': raw,
        'camera/image_raw/compressed': compressed,
        'camera/camera_info': camera_info,
        'joint_states': encode.joint_state(make, joints, MOUNT),
        'odom': encode.odometry(make, sample),
        'sweep/image': raw,
        'sweep/image/compressed': compressed,
        'sweep/camera_info': camera_info,
        'sweep/trajectory': encode.sweep_trajectory(make, frames, MOUNT),
        'sweep/pose': encode.pose(make, pose),
        'panorama/image': panorama_image,
        'panorama/camera_info': panorama_info,
        'panorama/pose': panorama_pose,
        'landmarks': points,
        'landmarks/atlas': atlas,
        'triplet': encode.triplet(make, triplet),
        'detections': encode.detections(make, found),
        'triangulation/pose': encode.pose(make, pose),
        'initialpose': encode.pose(make, pose),
        'global_localization/pose': encode.global_pose(make, place),
        'odometry/fused': encode.odometry(make, sample, np.eye(3) * 1e-4),
        'expectation': encode.expectation(make, expected, sample),
        'pan_tilt/command': encode.sweep_trajectory(make, frames[:1], MOUNT),
        'cmd_vel': make('geometry_msgs/msg/Twist'),
    }
