"""Results of the stages survive encoding and decoding, or are refused by name."""

import numpy as np
import pytest
from wire import assert_same, both, FACTORY, MOUNT, over_the_wire, STAMP

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.patches import PatchView
from landmark_nav.geometry.walls import Wall
from landmark_nav.messages import decode, encode
from landmark_nav.messages.clouds import DETECTIONS, GLOBAL_POSE, GlobalPose, pack_cloud
from landmark_nav.types import (
    Detections,
    JointSample,
    Landmark,
    LandmarkMap,
    OdometrySample,
    Panorama,
    PoseEstimate,
    Triplet,
)


@both
def test_joints_come_back_and_foreign_joints_are_none(deliver):
    sample = JointSample(STAMP, 1.25, -0.5)
    msg = encode.joint_state(FACTORY, sample, MOUNT)
    assert decode.joint_sample(deliver(msg), MOUNT) == sample
    msg.name = ['wheel_left', 'wheel_right']
    assert decode.joint_sample(deliver(msg), MOUNT) is None


@both
def test_a_tilt_comes_alone_where_its_joint_has_a_driver_of_its_own(deliver):
    msg = encode.joint_state(FACTORY, JointSample(STAMP, 1.25, -0.5), MOUNT)
    assert decode.lone_tilt(deliver(msg), MOUNT) is None
    msg.name = ['wheel_left', MOUNT.tilt_joint]
    assert decode.lone_tilt(deliver(msg), MOUNT) == (STAMP, -0.5)


def test_detections_of_older_recordings_know_of_no_delay():
    names = [name for name in DETECTIONS.fields.names if name not in DETECTIONS.optional]
    older = np.ones(3, dtype=[(name, DETECTIONS.fields[name]) for name in names])
    older['id'] = range(3)
    msg = pack_cloud(FACTORY, encode.header(FACTORY, STAMP, 'base_link'), older)
    again = decode.detections(msg)
    assert len(again) == 3
    assert again.joint_delay_s == 0.0


def some_panorama():
    rng = np.random.default_rng(3)
    return Panorama(
        STAMP,
        rng.integers(0, 256, (40, 200, 3)).astype(np.uint8),
        rng.random((40, 200)) > 0.3,
        Cylinder(200, 40, 31.0, 99.5, 19.0),
        np.array([1.0, 2.0, 1.1]),
        -2.0,
        np.diag([1.0, 2.0, 3.0, 4.0]) + 0.5,
    )


def some_map(count, factors):
    rng = np.random.default_rng(4)
    walls = (
        Wall('south', (0.0, 0.0), (5.0, 0.0), 2.5),
        Wall('ost-süd', (5.0, 0.0), (5.0, 4.0), 2.5),
        Wall('diagonal', (5.0, 4.0), (0.0, 0.0), 2.5),
    )
    landmarks = []
    for k in range(count):
        root = rng.normal(size=(3, 3)) * 0.01
        shared = rng.normal(size=(3, factors)) * 1e-3
        angle = rng.random() * 6
        landmarks.append(
            Landmark(
                id=3 * k + 1,
                position=rng.normal(size=3),
                covariance=root @ root.T + shared @ shared.T + 1e-6 * np.eye(3),
                shared_loading=shared,
                normal=np.array([np.cos(angle), np.sin(angle), 0.0]),
                width_m=0.2,
                height_m=0.3,
                patch=rng.integers(0, 256, (20 + k, 300)).astype(np.uint8),
                viewpoint=rng.normal(size=3),
                threshold=0.7,
                wall_id=walls[k % 3].id,
                saliency=0.5,
                views=tuple(
                    PatchView(
                        rng.normal(size=3), rng.integers(0, 256, (9, 8 + view)).astype(np.uint8)
                    )
                    for view in range(k % 3)
                ),
            )
        )
    return LandmarkMap(tuple(landmarks), 'map', walls)


RNG = np.random.default_rng(2)
COVARIANCE = np.diag([1.0, 2.0, 3.0]) + 0.1
JOINTS = tuple(JointSample(STAMP + k * 700_000_000, 0.1 * k, 0.01) for k in range(5))
ODOMETRY = OdometrySample(STAMP, np.array([1.0, -2.0, 3.0]), 0.2, -0.1)
POSE = PoseEstimate(STAMP, ODOMETRY.pose_odom_base, COVARIANCE)


def detections(count):
    return Detections(
        STAMP, np.arange(count) + 7, RNG.normal(size=count), RNG.random(count) + 0.1,
        RNG.random(count), 500 * RNG.random((count, 2)), np.array([50, 60])[: count // 2],
        joint_delay_s=0.04 if count else 0.0,
    )  # fmt: skip


@both
@pytest.mark.parametrize(
    ('sent', 'write', 'read'),
    [
        (JOINTS, encode.sweep_trajectory, decode.sweep_trajectory),
        (ODOMETRY, encode.odometry, decode.odometry),
        (POSE, encode.pose, decode.pose_estimate),
        (detections(0), encode.detections, decode.detections),
        (detections(4), encode.detections, decode.detections),
        (
            GlobalPose(STAMP, POSE.pose, COVARIANCE, np.array([4, 8, 15]), 0.7, 0.04),
            encode.global_pose,
            decode.global_pose,
        ),
        (
            Triplet(STAMP, np.array([3, 9, 1]), *RNG.random((2, 3)), 1e-4 * COVARIANCE, 0.4),
            encode.triplet,
            decode.triplet,
        ),
        (some_panorama(), encode.panorama, decode.panorama),
        (some_map(7, 6), encode.landmark_map, decode.landmark_map),
        (some_map(1, 0), encode.landmark_map, decode.landmark_map),
        (LandmarkMap(()), encode.landmark_map, decode.landmark_map),
    ],
    ids=lambda value: getattr(value, '__name__', type(value).__name__),
)
def test_what_is_sent_comes_back(deliver, sent, write, read):
    mount = (MOUNT,) if write is encode.sweep_trajectory else ()
    stamp = (STAMP,) if write is encode.landmark_map else ()
    messages = write(FACTORY, sent, *mount, *stamp)
    messages = messages if isinstance(messages, tuple) else (messages,)
    if write is encode.landmark_map:
        *messages, markers = messages
        over_the_wire(markers)
    # Positions in images and views travel as four bytes.
    assert_same(read(*map(deliver, messages), *mount), sent, rtol=1e-6)


def test_a_covariance_comes_with_odometry_and_a_pan_by_its_name():
    message = over_the_wire(encode.odometry(FACTORY, ODOMETRY, COVARIANCE, frame_id='map'))
    np.testing.assert_array_equal(decode.pose_estimate(message).covariance, COVARIANCE)
    with pytest.raises(LandmarkNavError, match='neck'):
        decode.sweep_trajectory(
            encode.sweep_trajectory(FACTORY, JOINTS, MOUNT), PanTiltMount(pan_joint='neck')
        )


def test_a_trajectory_before_its_start_is_refused():
    message = over_the_wire(encode.sweep_trajectory(FACTORY, JOINTS, MOUNT))
    message.points[1].time_from_start.sec = -5
    with pytest.raises(LandmarkNavError, match='time_from_start'):
        decode.sweep_trajectory(message, MOUNT)


def test_parts_that_do_not_belong_together_are_refused():
    camera_image, info, pose = encode.panorama(FACTORY, some_panorama())
    info.distortion_model = 'plumb_bob'
    with pytest.raises(LandmarkNavError, match='plumb_bob'):
        decode.panorama(camera_image, info, pose)
    pose.header = encode.header(FACTORY, STAMP + 1, 'map')
    with pytest.raises(LandmarkNavError, match='comes with'):
        decode.panorama(camera_image, info, pose)
    cloud, atlas, _ = encode.landmark_map(FACTORY, some_map(3, 2), STAMP)
    atlas.header = pose.header
    with pytest.raises(LandmarkNavError, match='different maps'):
        decode.landmark_map(cloud, atlas)


def test_a_found_place_names_landmarks():
    head, nothing = encode.header(FACTORY, STAMP, 'map'), np.zeros(0, dtype=GLOBAL_POSE.fields)
    with pytest.raises(LandmarkNavError, match='names no landmark'):
        decode.global_pose(pack_cloud(FACTORY, head, nothing))


def test_factory_refuses_fields_that_do_not_exist():
    with pytest.raises(TypeError, match='colour'):
        FACTORY('sensor_msgs/msg/Image', colour=1)
