"""Transforms in a recording lead from the map to the pixel of a landmark."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import encode
from landmark_nav.messages.factory import default_typestore, rosbag_factory
from landmark_nav.storage.bags.transforms import RobotTransforms
from landmark_nav.types import JointSample, OdometrySample

FACTORY, STORE = rosbag_factory(), default_typestore()
CAMERA = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
STAMP = 3 * 10**9
MOUNTS = [
    PanTiltMount((0.1, -0.05, 1.2), (0.02, -0.03, 0.4), (0.03, 0.01, 0.02)),
    # Hangs upside down, and so does the camera on it.
    PanTiltMount((0.0, 0.0, 1.0), (np.pi, 0.0, 0.0), (0.02, 0.0, 0.0), camera_roll_rad=np.pi),
]


def taken(transforms, topic, message):
    """Transforms that follow from a message, which can be written into a bag."""
    data = bytes(STORE.serialize_cdr(message, message.__msgtype__))
    found = list(transforms.of(topic, data))
    for _, made in found:
        STORE.serialize_cdr(made, made.__msgtype__)
    return found


def matrix(transform):
    t, q = transform.translation, transform.rotation
    whole = np.eye(4)
    whole[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    whole[:3, 3] = t.x, t.y, t.z
    return whole


@pytest.mark.parametrize('mount', MOUNTS)
def test_the_tree_leads_from_the_map_to_the_camera(mount):
    transforms = RobotTransforms(mount)
    odometry, fused = np.array([1.0, 0.5, 0.3]), np.array([2.0, -1.0, 2.9])
    joints = JointSample(STAMP, 0.7, -0.2)
    messages = {
        'camera/camera_info': encode.camera_info(FACTORY, CAMERA, STAMP, 'optical'),
        'odom': encode.odometry(FACTORY, OdometrySample(STAMP, odometry)),
        'odometry/fused': encode.odometry(
            FACTORY, OdometrySample(STAMP, fused), np.eye(3), frame_id='map'
        ),
        'joint_states': encode.joint_state(FACTORY, joints, mount),
        'detections': encode.header(FACTORY, 0, ''),
    }
    found = [one for item in messages.items() for one in taken(transforms, *item)]
    assert {topic for topic, _ in found} == {'tf', 'tf_static'}
    tree = {t.child_frame_id: t for _, message in found for t in message.transforms}
    pose, frame, passed = np.eye(4), 'optical', []
    while frame in tree:
        pose = matrix(tree[frame].transform) @ pose
        frame = tree[frame].header.frame_id
        passed.append(frame)
    assert passed == ['tilt_link', 'pan_link', 'base_link', 'odom', 'map']
    rotation, center = mount.camera_pose_map(fused, joints.pan_rad, joints.tilt_rad)
    np.testing.assert_allclose(pose[:3, :3], rotation, atol=1e-9)
    np.testing.assert_allclose(pose[:3, 3], center, atol=1e-9)
