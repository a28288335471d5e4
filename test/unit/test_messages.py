"""What crosses the stages comes back from its messages, or is refused by name."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
import numpy as np
import pytest
from wire import both, FACTORY, MOUNT, over_the_wire, STAMP

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.cylinder import Cylinder
from landmark_nav.geometry.patches import PatchView
from landmark_nav.geometry.walls import Wall
from landmark_nav.messages import decode, encode
from landmark_nav.messages.clouds import pack_cloud, unpack_cloud
from landmark_nav.messages.layouts import (
    DETECTIONS,
    GLOBAL_POSE,
    GlobalPose,
    Layout,
    TRIPLET,
)
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
    msg.position = np.array([0.0, np.nan])
    with pytest.raises(LandmarkNavError, match='joint_states position'):
        decode.lone_tilt(deliver(msg), MOUNT)
    msg.position = msg.position[:1]
    with pytest.raises(LandmarkNavError, match='1 values for 2 joints'):
        decode.lone_tilt(deliver(msg), MOUNT)


@both
def test_trajectory_comes_back(deliver):
    samples = tuple(JointSample(STAMP + k * 700_000_000, 0.1 * k, 0.01) for k in range(5))
    msg = deliver(encode.sweep_trajectory(FACTORY, samples, MOUNT))
    assert decode.sweep_trajectory(msg, MOUNT) == samples
    with pytest.raises(LandmarkNavError, match='neck'):
        decode.sweep_trajectory(msg, PanTiltMount(pan_joint='neck'))


@both
def test_odometry_and_poses_come_back(deliver):
    sample = OdometrySample(STAMP, np.array([1.0, -2.0, 3.0]), 0.2, -0.1)
    covariance = np.diag([1.0, 2.0, 3.0]) + 0.1
    msg = deliver(encode.odometry(FACTORY, sample, covariance, frame_id='map'))
    decoded = decode.odometry(msg)
    np.testing.assert_allclose(decoded.pose_odom_base, sample.pose_odom_base, atol=1e-12)
    assert (decoded.linear_m_s, decoded.angular_rad_s) == (0.2, -0.1)
    np.testing.assert_array_equal(decode.pose_estimate(msg).covariance, covariance)
    estimate = PoseEstimate(STAMP, sample.pose_odom_base, covariance)
    again = decode.pose_estimate(deliver(encode.pose(FACTORY, estimate)))
    np.testing.assert_allclose(again.pose, estimate.pose, atol=1e-12)
    np.testing.assert_array_equal(again.covariance, covariance)


def test_values_that_are_no_numbers_are_refused_with_what_and_when():
    msg = encode.odometry(FACTORY, OdometrySample(STAMP, np.array([1.0, np.nan, 0.0])))
    with pytest.raises(LandmarkNavError, match=r'odometry position at 5000\.000 s'):
        decode.odometry(msg)
    with pytest.raises(LandmarkNavError, match='pose position'):
        decode.pose_estimate(msg)
    msg = encode.odometry(FACTORY, OdometrySample(STAMP, np.zeros(3)))
    msg.pose.pose.orientation.w = 0.0
    with pytest.raises(LandmarkNavError, match='zero quaternion'):
        decode.odometry(msg)
    msg.pose.pose.orientation.x = 1.0
    with pytest.raises(LandmarkNavError, match='fallen over'):
        decode.odometry(msg)
    far = encode.odometry(FACTORY, OdometrySample(STAMP, np.array([0.0, 1e300, 0.0])))
    with pytest.raises(LandmarkNavError, match='odometry position'):
        decode.odometry(far)
    fast = encode.odometry(FACTORY, OdometrySample(STAMP, np.zeros(3), 1e300, 0.0))
    with pytest.raises(LandmarkNavError, match='odometry speed'):
        decode.odometry(fast)
    joints = encode.joint_state(FACTORY, JointSample(STAMP, np.inf), MOUNT)
    with pytest.raises(LandmarkNavError, match='joint_states position'):
        decode.joint_sample(joints, MOUNT)
    joints.position = joints.position[:1]
    with pytest.raises(LandmarkNavError, match='1 values for 2 joints'):
        decode.joint_sample(joints, MOUNT)


SCALARS = st.sampled_from(['<u4', '<i2', 'u1', '<f4', '<f8'])


@settings(max_examples=40)
@given(
    data=st.data(),
    kinds=st.lists(st.tuples(SCALARS, st.integers(1, 4)), min_size=1, max_size=5),
    count=st.integers(0, 6),
)
def test_clouds_come_back(data, kinds, count):
    dtype = np.dtype(
        [
            (f'f{k}', kind) if size == 1 else (f'f{k}', kind, (size,))
            for k, (kind, size) in enumerate(kinds)
        ]
    )
    raw = data.draw(hnp.arrays(np.uint8, count * dtype.itemsize))
    points = np.frombuffer(raw.tobytes(), dtype=dtype)
    msg = over_the_wire(pack_cloud(FACTORY, encode.header(FACTORY, STAMP, 'map'), points))
    again = unpack_cloud(msg, Layout('any', dtype))
    assert again.dtype.names == dtype.names
    for name in dtype.names:
        np.testing.assert_array_equal(again[name], points[name])


def test_cloud_without_a_field_or_with_too_few_bytes_is_refused():
    points = np.zeros(3, np.dtype([('id', '<u4'), ('x', '<f4')]))
    msg = pack_cloud(FACTORY, encode.header(FACTORY, STAMP, 'map'), points)
    with pytest.raises(LandmarkNavError, match='lacks the field bearing'):
        unpack_cloud(msg, TRIPLET)
    msg.data = msg.data[:-1]
    with pytest.raises(LandmarkNavError, match='23 bytes'):
        unpack_cloud(msg, Layout('points', points.dtype))


@both
@pytest.mark.parametrize('count', [0, 4])
def test_detections_come_back(deliver, count):
    rng = np.random.default_rng(2)
    found = Detections(
        STAMP,
        np.arange(count) + 7,
        rng.normal(size=count),
        rng.random(count),
        rng.random(count),
        rng.random((count, 2)) * 500,
        np.array([50, 60])[: count // 2],
        joint_delay_s=0.04,
    )
    again = decode.detections(deliver(encode.detections(FACTORY, found)))
    np.testing.assert_array_equal(again.missed, found.missed)
    np.testing.assert_array_equal(again.ids, found.ids)
    np.testing.assert_array_equal(again.bearing_rad, found.bearing_rad)
    np.testing.assert_array_equal(again.variance_rad2, found.variance_rad2)
    np.testing.assert_allclose(again.uv_px, found.uv_px, rtol=1e-6)
    assert again.stamp_ns == STAMP
    if count:
        assert again.joint_delay_s == 0.04


def test_detections_of_older_recordings_know_of_no_delay():
    names = [name for name in DETECTIONS.fields.names if name not in DETECTIONS.optional]
    older = np.ones(3, dtype=[(name, DETECTIONS.fields[name]) for name in names])
    older['id'] = range(3)
    msg = pack_cloud(FACTORY, encode.header(FACTORY, STAMP, 'base_link'), older)
    again = decode.detections(msg)
    assert len(again) == 3
    assert again.joint_delay_s == 0.0


@pytest.mark.parametrize('value', [np.nan, -np.inf])
@pytest.mark.parametrize('seen', [0, 3])
def test_detections_with_a_delay_that_is_no_number_are_refused(value, seen):
    points = np.zeros(4, dtype=DETECTIONS.fields)
    points['id'] = range(4)
    points['joint_delay'] = value
    points['bearing'][seen:] = points['bearing_variance'][seen:] = np.nan
    msg = pack_cloud(FACTORY, encode.header(FACTORY, STAMP, 'base_link'), points)
    with pytest.raises(LandmarkNavError, match=r'detections delay at .* not a number'):
        decode.detections(msg)


@both
def test_found_place_comes_back(deliver):
    rng = np.random.default_rng(3)
    pose, root = rng.normal(size=3), rng.normal(size=(3, 3))
    covariance = root @ root.T
    place = GlobalPose(STAMP, pose, covariance, np.array([4, 8, 15]), 0.7, 0.04)
    again = decode.global_pose(deliver(encode.global_pose(FACTORY, place)))
    assert again.stamp_ns == STAMP
    np.testing.assert_array_equal(again.pose, pose)
    np.testing.assert_array_equal(again.covariance, covariance)
    np.testing.assert_array_equal(again.ids, place.ids)
    assert (again.pan_rate_rad_s, again.joint_delay_s) == (0.7, 0.04)


def test_found_place_without_landmarks_or_numbers_is_refused():
    short = np.zeros(1, dtype=[(k, 'f8') for k in GLOBAL_POSE.fields.names])
    with pytest.raises(LandmarkNavError, match='field id is 1 of type float64'):
        decode.global_pose(pack_cloud(FACTORY, encode.header(FACTORY, STAMP, 'map'), short))
    head, points = encode.header(FACTORY, STAMP, 'map'), np.zeros(2, dtype=GLOBAL_POSE.fields)
    points['id'] = range(2)
    with pytest.raises(LandmarkNavError, match='names no landmark'):
        decode.global_pose(pack_cloud(FACTORY, head, points[:0]))
    points['pan_rate'] = np.nan
    with pytest.raises(LandmarkNavError, match=r'global_localization/pose pan .* not a number'):
        decode.global_pose(pack_cloud(FACTORY, head, points))


@both
def test_triplet_comes_back(deliver):
    chosen = Triplet(
        STAMP,
        np.array([3, 9, 1]),
        np.array([0.1, 0.2, -0.3]),
        np.array([0.01, 0.02, 0.03]),
        np.diag([1e-4, 2e-4, 3e-5]),
        0.4,
    )
    again = decode.triplet(deliver(encode.triplet(FACTORY, chosen)))
    for name in ('ids', 'bearing_rad', 'sigma_rad', 'covariance', 'pan_rad'):
        np.testing.assert_array_equal(getattr(again, name), getattr(chosen, name))


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


@both
def test_panorama_comes_back(deliver):
    view = some_panorama()
    messages = [deliver(m) for m in encode.panorama(FACTORY, view)]
    again = decode.panorama(*messages)
    np.testing.assert_array_equal(again.image, view.image)
    np.testing.assert_array_equal(again.mask, view.mask)
    assert again.cylinder == view.cylinder
    np.testing.assert_array_equal(again.center_map, view.center_map)
    np.testing.assert_allclose(again.heading_rad, view.heading_rad)
    np.testing.assert_array_equal(again.covariance, view.covariance)


def test_panorama_of_parts_that_do_not_belong_together_is_refused():
    camera_image, info, pose = encode.panorama(FACTORY, some_panorama())
    info.distortion_model = 'plumb_bob'
    with pytest.raises(LandmarkNavError, match='plumb_bob'):
        decode.panorama(camera_image, info, pose)
    pose.header = encode.header(FACTORY, STAMP + 1, 'map')
    with pytest.raises(LandmarkNavError, match='comes with'):
        decode.panorama(camera_image, info, pose)


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


@both
@pytest.mark.parametrize(('count', 'factors'), [(7, 6), (1, 0)])
def test_map_comes_back(deliver, count, factors):
    sent = some_map(count, factors)
    cloud, atlas, markers = encode.landmark_map(FACTORY, sent, STAMP)
    over_the_wire(markers)
    again = decode.landmark_map(deliver(cloud), deliver(atlas))
    assert again.walls == sent.walls
    np.testing.assert_array_equal(again.ids, sent.ids)
    np.testing.assert_allclose(again.positions, sent.positions, rtol=1e-6)
    np.testing.assert_array_equal(again.covariances, sent.covariances)
    np.testing.assert_array_equal(again.joint_covariance_xy, sent.joint_covariance_xy)
    for one, other in zip(again.landmarks, sent.landmarks, strict=True):
        np.testing.assert_array_equal(one.patch, other.patch)
        np.testing.assert_allclose(one.normal, other.normal, atol=1e-6)
        np.testing.assert_allclose(one.viewpoint, other.viewpoint, rtol=1e-6)
        assert one.wall_id == other.wall_id
        assert one.threshold == pytest.approx(other.threshold)
        for view, sent_view in zip(one.views, other.views, strict=True):
            np.testing.assert_allclose(view.viewpoint, sent_view.viewpoint, rtol=1e-6)
            np.testing.assert_array_equal(view.patch, sent_view.patch)


def test_empty_map_travels_and_a_foreign_atlas_is_refused():
    cloud, atlas, _ = encode.landmark_map(FACTORY, LandmarkMap(()), STAMP)
    assert decode.landmark_map(over_the_wire(cloud), over_the_wire(atlas)).landmarks == ()
    cloud, _, _ = encode.landmark_map(FACTORY, some_map(3, 2), STAMP)
    with pytest.raises(LandmarkNavError, match='do not fit an atlas'):
        decode.landmark_map(cloud, atlas)
    atlas.header = encode.header(FACTORY, STAMP + 1, 'map')
    with pytest.raises(LandmarkNavError, match='different maps'):
        decode.landmark_map(cloud, atlas)


def test_factory_refuses_fields_that_do_not_exist():
    with pytest.raises(TypeError, match='colour'):
        FACTORY('sensor_msgs/msg/Image', colour=1)
