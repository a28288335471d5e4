"""The fusion node with messages that are late, missing or older than the start."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from landmark_nav.messages import decode, encode
from landmark_nav.messages.clouds import GlobalPose
from landmark_nav.nodes.odometry_fusion import OdometryFusionNode
from landmark_nav.ros.topics import ros_factory
from landmark_nav.types import Detections, LandmarkMap, OdometrySample, PoseEstimate

PERIOD_NS, SPEED_M_S = 50_000_000, 0.4
SURE = np.diag([0.02, 0.02, 0.01]) ** 2


class Fusion:
    """A node without neighbours, its callbacks and what it publishes, on a clock of its own."""

    def __init__(self, graph, robot):
        self.node: Any = graph.make(OdometryFusionNode, robot_file=robot)
        self.published: list[Any] = []
        self.now_ns = 0
        self.node._fused = SimpleNamespace(publish=self.published.append)
        self.node.get_clock = lambda: SimpleNamespace(
            now=lambda: SimpleNamespace(nanoseconds=self.now_ns)
        )
        self._odom = self.node.guarded('odom', self.node._on_odometry)
        self._place = self.node.guarded('global_localization/pose', self.node._on_global_pose)
        self.node._fusion.change_map(LandmarkMap(()))

    def odometry(self, k, way_m=None):
        way = SPEED_M_S * 1e-9 * PERIOD_NS * k if way_m is None else way_m
        sample = OdometrySample(k * PERIOD_NS, np.array([way, 0.0, 0.0]), SPEED_M_S)
        self._odom(encode.odometry(ros_factory, sample))

    def start(self, stamp_ns, x):
        pose = PoseEstimate(stamp_ns, np.array([x, 0.0, 0.0]), SURE)
        self.node._on_initial_pose(encode.pose(ros_factory, pose))

    def found(self, stamp_ns, x):
        place = GlobalPose(stamp_ns, np.array([x, 0.0, 0.0]), SURE, np.arange(3))
        self._place(encode.global_pose(ros_factory, place))

    def reason(self):
        return str(self.node._checked_health().reason)


@pytest.fixture
def fusion(graph, tmp_path):
    robot = tmp_path / 'robot.yaml'
    robot.write_text('pan_axis:\n  xyz: [0.0, 0.0, 1.1]\n')
    return Fusion(graph, str(robot))


def test_a_late_sample_does_not_set_back_what_is_reported(fusion):
    fusion.start(0, 0.0)
    for k in (0, 1, 2, 4, 5, 3, 6):
        fusion.odometry(k)
        fusion.node._corrected(k * PERIOD_NS)
    stamps = [decode.stamp_ns(one.header) for one in fusion.published]
    assert stamps == sorted(stamps)
    assert stamps[-1] == 6 * PERIOD_NS


def test_a_robot_whose_odometry_hangs_with_nothing_in_view_is_lost_in_time(fusion):
    fusion.start(0, 0.0)
    reported = []
    for k in range(200):
        fusion.now_ns = k * PERIOD_NS
        fusion.odometry(k, way_m=None if k < 20 else 0.38)
        reported.append(fusion.reason())
    assert 'odom dropped: odometry has frozen' in reported[30]
    assert 'no odometry for' in reported[50]
    assert 'sigma' in reported[-1]


def test_a_place_of_before_a_start_that_was_given_is_not_taken(fusion):
    for k in range(20):
        fusion.now_ns = k * PERIOD_NS
        fusion.odometry(k)
    fusion.start(fusion.now_ns, 1.0)
    fusion.found(fusion.now_ns - 3 * PERIOD_NS, 4.0)
    assert 'before the given start pose' in fusion.reason()
    for k in range(20, 30):
        fusion.now_ns = k * PERIOD_NS
        fusion.odometry(k)
    assert decode.odometry(fusion.published[-1]).pose_odom_base[0] == pytest.approx(1.2, abs=0.01)
    fusion.found(25 * PERIOD_NS, 4.0)
    fusion.odometry(30)
    assert decode.odometry(fusion.published[-1]).pose_odom_base[0] == pytest.approx(4.1, abs=0.01)


def test_a_place_keeps_its_time_where_odometry_comes_seconds_late(fusion):
    for k in range(61):
        fusion.now_ns = k * PERIOD_NS
        fusion.odometry(k)
        if k == 10:
            fusion.found(50 * PERIOD_NS, 4.0)
    assert decode.odometry(fusion.published[-1]).pose_odom_base[0] == pytest.approx(4.2, abs=0.01)


def test_odometry_that_comes_twice_is_no_news_and_that_of_a_known_stamp_is_dropped(fusion):
    fusion.start(0, 0.0)
    fusion.odometry(0)
    fusion.odometry(1)
    count = len(fusion.published)
    fusion.odometry(1)
    assert len(fusion.published) == count
    assert 'dropped' not in fusion.reason()
    fusion.odometry(1, way_m=0.01)
    assert len(fusion.published) == count
    assert 'odom dropped' in fusion.reason()


def test_detections_of_another_clock_do_not_set_the_time_of_what_is_fused(fusion):
    fusion.start(0, 1.0)
    fusion.odometry(0)
    count = len(fusion.published)
    none = np.empty(0)
    seen = Detections(3600 * 10**9, none.astype(np.int64), none, none, none, np.empty((0, 2)))
    fusion.node._on_detections(encode.detections(ros_factory, seen, 'base_link'))
    assert len(fusion.published) == count
    assert 'detections dropped' in fusion.reason()


def test_map_to_odom_is_broadcast_once_for_each_stamp(fusion):
    sent = []
    fusion.node._transform = SimpleNamespace(send=lambda stamp_ns, _: sent.append(stamp_ns))
    fusion.start(0, 0.0)
    for k in (0, 1, 1, 2, 3):
        fusion.odometry(k)
        # As an image does, which comes with a stamp of the odometry, or between two.
        fusion.node._corrected(k * PERIOD_NS)
        fusion.node._corrected(k * PERIOD_NS - PERIOD_NS // 2)
    assert sent == [k * PERIOD_NS for k in range(4)]
    assert len(fusion.published) > len(sent)
