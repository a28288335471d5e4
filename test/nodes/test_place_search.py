"""When the pose is searched without a request, and the camera turned for it."""

from dataclasses import replace
import time
from types import SimpleNamespace
from typing import Any, cast

from graph import map_sender
from harness import BAGS
import numpy as np
import pytest
from rclpy.task import Future

from landmark_nav.calibration import Calibration
from landmark_nav.configuration import Configuration
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.expected_poses import ExpectedPoses
from landmark_nav.localization.relocalization.search import RelocalizationConfig
from landmark_nav.localization.relocalization.stream import Relocalizer
from landmark_nav.messages import decode, encode
from landmark_nav.nodes.triangulation_localizer import PlaceSearch
from landmark_nav.ros.camera_frames import listen_for_pan, PanCommander
from landmark_nav.ros.topics import ros_factory
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.robot_files import load_robot
from landmark_nav.types import CameraFrame, JointSample, LandmarkMap, OdometrySample, PoseEstimate

SECOND = 10**9
SURE, WIDE = 1e-4 * np.eye(3), np.eye(3)


@pytest.fixture
def search():
    """A search, the poses it expects (`prior`) and what it reports (`reported`)."""
    prior, reported = ExpectedPoses(0.5), []
    node: Any = SimpleNamespace(
        advertise=lambda _name: SimpleNamespace(publish=reported.append),
        offer=lambda service, action, **_: None,
        ended=Future(),
        config=replace(Configuration(), relocalization=RelocalizationConfig(search_s=0.2)),
    )
    made: Any = PlaceSearch(node, Calibration.of_mount(PanTiltMount()), prior.recent)
    landmark: Any = SimpleNamespace(edge=False, shared_loading=np.zeros((3, 0)))
    made.use(LandmarkMap((landmark,)))
    made.add_odometry(OdometrySample(0, np.zeros(3)))
    made.prior, made.reported = prior, reported
    return made


def fuse(search, stamp_ns, covariance):
    pose = PoseEstimate(stamp_ns, np.zeros(3), covariance)
    search.prior.add(pose, OdometrySample(stamp_ns, np.zeros(3)))


def test_it_searches_where_no_pose_or_an_uncertain_one_is_known(search):
    search.consider(0)
    assert search.active
    fuse(search, 0, SURE)
    search.consider(0)
    assert not search.active
    fuse(search, 0, WIDE)
    search.consider(0)
    assert search.active


def test_a_fused_pose_that_is_late_is_waited_for(search):
    fuse(search, 0, SURE)
    search.consider(SECOND)
    assert not search.active
    search.consider(3 * SECOND)
    assert search.active, 'who fused has ended'
    fuse(search, 3 * SECOND, SURE)
    search.consider(3 * SECOND)
    assert not search.active


class Finder:
    """Finds a place with every image."""

    in_time = PoseEstimate(SECOND, np.array([1.0, 2.0, 0.5]), SURE)
    landmark_ids = np.array([3, 7])

    def __init__(self, meanwhile=lambda: None):
        self._meanwhile = meanwhile

    def add_odometry(self, sample):
        """Not needed."""

    def add_frame(self, frame):
        self._meanwhile()
        return replace(self.in_time, covariance=WIDE)


def frame_at(stamp_ns):
    lens = CameraModel(16, 16, 16.0, 16.0, 8.0, 8.0)
    return CameraFrame(stamp_ns, np.zeros((16, 16), np.uint8), lens, 0.0, pan_rate_rad_s=0.7)


def test_a_place_is_reported_with_what_it_was_found_from(search):
    search.consider(SECOND)
    search._relocalizer = cast(Relocalizer, Finder())
    search.look(frame_at(SECOND))
    place = decode.global_pose(search.reported[0])
    assert place.stamp_ns == SECOND
    np.testing.assert_array_equal(place.pose, Finder.in_time.pose)
    np.testing.assert_array_equal(place.covariance, SURE)
    assert place.ids.tolist() == [3, 7]
    assert place.pan_rate_rad_s == 0.7
    # It takes a moment to become the fused pose; if it does not, the search begins anew.
    search.consider(SECOND + SECOND // 2)
    assert not search.active
    search.consider(3 * SECOND)
    assert search.active


def test_a_place_in_a_map_that_is_gone_is_not_reported(search):
    search.consider(SECOND)
    search._relocalizer = cast(Relocalizer, Finder(lambda: search.use(search.landmarks)))
    search.look(frame_at(SECOND))
    assert not search.reported
    assert search.active


SELECTOR = 'triplet_selector'
LIMITS = (-1.2, 0.9)


def test_it_looks_around_within_the_limits_and_leaves_the_camera_to_others(
    start, client, learned_map, tmp_path
):
    mount = load_robot(str(BAGS / 'robot.yaml'))
    drive = Bag(BAGS / 'drive')
    info = next(drive.messages([drive.require('camera/camera_info')])).message
    camera = decode.camera_model(info)
    topics = ('camera/camera_info', 'joint_states', 'odometry/fused')
    infos, joints, fused = (client.advertise(topic) for topic in topics)
    robot = tmp_path / 'robot.yaml'
    limits = f'pan_min: {LIMITS[0]}\npan_max: {LIMITS[1]}\n'
    robot.write_text((BAGS / 'robot.yaml').read_text() + limits)
    start(SELECTOR, robot_file=str(robot), yield_s=1.5)
    map_sender(client)(load_map(learned_map))
    commands: list[float] = []
    others: list[float] = []
    known = False

    def take(pan_rad):
        if pan_rad not in others:
            commands.append(pan_rad)

    def alive():
        """Be a robot whose joint is where it was commanded, for a moment."""
        now_ns = time.time_ns()
        infos.publish(encode.camera_info(ros_factory, camera, now_ns, 'camera'))
        pan = commands[-1] if commands else 0.0
        joints.publish(encode.joint_state(ros_factory, JointSample(now_ns, pan), mount))
        if known:
            sample = OdometrySample(now_ns, np.array([2.0, 2.0, 0.0]), 0.0, 0.0)
            sigma = np.diag([1e-4, 1e-4, 1e-4])
            fused.publish(
                encode.odometry(ros_factory, sample, sigma, frame_id='map', child_frame_id='base')
            )
        return False

    def live(seconds, until=lambda: False):
        end = time.monotonic() + seconds
        client.wait(lambda: alive() or until() or time.monotonic() > end, seconds + 1.0, 'time')

    listen_for_pan(client._node, mount, 'JointTrajectory', take)
    other = PanCommander(client._node, mount, 'JointTrajectory')
    live(20.0, lambda: len(set(commands)) >= 4)
    assert len(set(commands)) >= 4
    assert all(LIMITS[0] <= pan <= LIMITS[1] for pan in commands)
    live(3.0, lambda: 'looks around' in client.status_of(SELECTOR).reason)
    assert 'looks around' in client.status_of(SELECTOR).reason

    others.append(0.123)
    other.command(0.123)
    live(0.4)
    before = len(commands)
    live(0.8)
    assert len(commands) == before, 'somebody else turns the camera'
    live(8.0, lambda: len(commands) > before)
    assert len(commands) > before

    known = True
    live(3.0, lambda: 'looks around' not in client.status_of(SELECTOR).reason)
    assert 'looks around' not in client.status_of(SELECTOR).reason
