"""Pan and tilt at the stamp of an image, and transforms of a recording."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import encode
from landmark_nav.messages.factory import default_typestore, rosbag_factory
from landmark_nav.simulation.pan_tilt_unit import PanTiltConfig, PanTiltUnit
from landmark_nav.storage.bags.timelines import JointHistory
from landmark_nav.storage.bags.transforms import RobotTransforms
from landmark_nav.types import JointSample, OdometrySample, Refusal

MS = 1_000_000
RATE = 0.9


def turning(*stamps_ms):
    return JointHistory(JointSample(t * MS, 1e-3 * RATE * t, -2e-4 * t) for t in stamps_ms)


@pytest.mark.parametrize(
    ('known_ms', 'at_ms', 'words'),
    [
        ((), 100, 'no joint_states'),
        ((100, 120), 172, 'joint_states are 52 ms behind'),
        ((100,), 105, 'joint_states are 5 ms behind'),
        ((100, 120), 80, 'joint_states begin 20 ms later'),
        ((100, 1300), 150, 'no joint_states for 1.2 s'),
    ],
)
def test_what_no_joint_state_gives_is_refused(known_ms, at_ms, words):
    refusal = turning(*known_ms).at(at_ms * MS)
    assert isinstance(refusal, Refusal)
    assert str(refusal) == words


@pytest.mark.parametrize('period_ms', [10, 20, 50])
def test_what_interpolation_leaves_open_is_claimed(period_ms):
    """A unit that turns here and there, and swings after each stop."""
    rng, step_ms = np.random.default_rng(1), 5
    unit, true = PanTiltUnit(PanTiltConfig(encoder_step_rad=0.0)), []
    for k in range(4000):
        if k % 250 == 0:
            unit.command(rng.uniform(-2.0, 2.0))
        unit.step(1e-3 * step_ms)
        true.append(unit.angles_rad[0])
    off, sigma = interpolated(np.array(true), step_ms, period_ms)
    every = period_ms // step_ms
    assert not sigma[::every].any()
    between = np.arange(len(off)) % every > 0
    normalized = (off / np.hypot(sigma, 1e-4))[between]
    assert np.sqrt(np.mean(np.square(normalized))) < 1.0
    assert np.mean(np.abs(normalized) > 3.0) < 0.01


def interpolated(true, step_ms, period_ms, shift_ms=0):
    """Errors and sigmas (n,) of pans that are known each `period_ms`, at all steps between."""
    every, first = period_ms // step_ms, shift_ms // step_ms
    known = [JointSample(k * step_ms * MS, true[k]) for k in range(first, len(true), every)]
    history, found = JointHistory(known), []
    for k in range(first + every, len(true) - 3 * every):
        sample = history.at(k * step_ms * MS)
        assert isinstance(sample, JointSample)
        found.append((sample.pan_rad - true[k], sample.pan_sigma_rad))
    off, sigma = np.array(found).T
    return off, sigma


@pytest.mark.parametrize(('period_ms', 'shift_ms'), [(100, 0), (100, 30), (200, 0), (200, 70)])
def test_what_few_joint_states_do_not_show_is_claimed(period_ms, shift_ms):
    """A unit that is sent on ten times a second turns unevenly; it starts, stops and swings."""
    rng, step_ms, goal, rate = np.random.default_rng(2), 5, 0.0, 0.0
    unit, smooth = PanTiltUnit(PanTiltConfig(encoder_step_rad=0.0, pan_limit_rad=6.3)), []
    for k in range(24_000):
        if k % 300 == 0:
            rate = float(rng.choice([0.0, 0.2, 0.4])) * (-1.0 if goal > 0.0 else 1.0)
        goal += 1e-3 * step_ms * rate
        unit.command(goal)
        unit.step(1e-3 * step_ms)
        smooth.append(unit.angles_rad[0])
    # Ten times a second faster and slower by a quarter.
    phase = 2.0 * np.pi * 10.0 * 1e-3 * step_ms * np.arange(len(smooth))
    true = smooth + 0.25 * np.gradient(smooth) / np.diff(phase)[0] * np.sin(phase)
    off, sigma = interpolated(true, step_ms, period_ms, shift_ms)
    normalized = off / np.hypot(sigma, 2e-4)
    assert np.sqrt(np.mean(np.square(normalized))) < 1.0
    assert np.mean(np.abs(normalized) > 5.0) < 0.002


@pytest.mark.parametrize('period_ms', [20, 200])
def test_a_driver_that_reports_the_pan_within_half_a_turn(period_ms):
    stamps_ms = range(0, 20_000, period_ms)
    true = [1e-3 * RATE * t for t in stamps_ms]
    known = zip(stamps_ms, wrap_rad(true).tolist(), strict=True)
    history = JointHistory(JointSample(t * MS, pan) for t, pan in known)
    for t in range(1000, 19_000, 7):
        found = history.at(t * MS)
        assert isinstance(found, JointSample)
        assert wrap_rad(found.pan_rad - 1e-3 * RATE * t) == pytest.approx(0.0, abs=1e-9)
        assert abs(found.pan_rad) < np.pi + 1e-3 * RATE * period_ms
        assert found.pan_rate_rad_s == pytest.approx(RATE)
        assert found.pan_track is not None
        turned = found.pan_track.at([-0.3, 0.0, 0.3]) - found.pan_rad
        np.testing.assert_allclose(turned, [-0.3 * RATE, 0.0, 0.3 * RATE], atol=1e-9)


def test_a_tilt_of_another_driver_is_interpolated_and_stays():
    samples = [JointSample(t * MS, 0.1) for t in range(0, 500, 20)]
    history = JointHistory(samples, [(250 * MS, 0.5), (150 * MS, 0.3)])
    for at_ms, tilt in ((100, 0.3), (150, 0.3), (175, 0.35), (230, 0.46), (400, 0.5)):
        found = history.at(at_ms * MS)
        assert isinstance(found, JointSample)
        assert found.tilt_rad == pytest.approx(tilt, abs=1e-6)


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
