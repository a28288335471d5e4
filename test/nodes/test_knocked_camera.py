"""A robot stands and its camera is displaced: odometry is less certain, but it is used."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.messages import decode, encode
from landmark_nav.types import (
    Detections,
    FloatArray,
    Landmark,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
)

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.context import Context
from rclpy.parameter import Parameter

from landmark_nav.nodes.odometry_fusion import OdometryFusionNode
from landmark_nav.ros.factory import ros_factory

PERIOD_NS, DISPLACED_AT, SIGMA_RAD = 50_000_000, 20, 5e-4
# Seen from a robot in the origin, whose pan axis is there, too.
DIRECTIONS = np.linspace(-3.0, 3.0, 8)


def landmark(number: int, direction: float) -> Landmark:
    inward = -np.array([np.cos(direction), np.sin(direction), 0.0])
    return Landmark(
        id=number,
        position=-3.0 * inward + [0.0, 0.0, 1.2],
        covariance=0.005**2 * np.eye(3),
        shared_loading=np.zeros((3, 3)),
        normal=inward,
        width_m=0.2,
        height_m=0.2,
        patch=np.zeros((8, 8), np.uint8),
        viewpoint=np.zeros(3),
        threshold=0.7,
    )


def found(k: int, off_rad: FloatArray) -> Detections:
    of = (k // 2 + np.arange(4)) % len(DIRECTIONS)
    variance = np.full(4, SIGMA_RAD**2)
    seen = wrap_rad(DIRECTIONS[of] + off_rad)
    return Detections(k * PERIOD_NS, of, seen, variance, np.ones(4), np.zeros((4, 2)))


def test_odometry_that_is_flagged_is_fused_all_the_same(domain_id: int, tmp_path: Any) -> None:
    robot = tmp_path / 'robot.yaml'
    robot.write_text('pan_axis:\n  xyz: [0.0, 0.0, 1.1]\n')
    rng = np.random.default_rng(0)
    context = Context()
    context.init(domain_id=domain_id)
    node = OdometryFusionNode(
        context=context, parameter_overrides=[Parameter('robot_file', value=str(robot))]
    )
    fused: list[Any] = []
    node._fused = SimpleNamespace(publish=fused.append)
    landmarks = [landmark(k, direction) for k, direction in enumerate(DIRECTIONS)]
    try:
        hear = node.guarded('odom', node._on_odometry)
        node._filter.change_map(LandmarkMap(tuple(landmarks)))
        start = PoseEstimate(0, np.zeros(3), np.diag([0.02, 0.02, 0.01]) ** 2)
        node._on_initial_pose(encode.pose(ros_factory, start))
        reported = []
        for k in range(60):
            fused.clear()
            hear(encode.odometry(ros_factory, OdometrySample(k * PERIOD_NS, np.zeros(3))))
            assert [decode.stamp_ns(one.header) for one in fused] == [k * PERIOD_NS]
            reported.append(node._checked_health().reason)
            if k % 2 == 0:
                off = rng.normal(0.0, SIGMA_RAD, 4) + (0.03 if k >= DISPLACED_AT else 0.0)
                node._on_detections(encode.detections(ros_factory, found(k, off)))
        inflated = ['odometry stands' in reason for reason in reported]
        assert inflated.index(True) == DISPLACED_AT + 1
        assert sum(inflated) > 10
        assert 'dropped' not in ''.join(reported)
        # What comes twice is no news, and what can't be used is reported as before.
        fused.clear()
        hear(encode.odometry(ros_factory, OdometrySample(k * PERIOD_NS, np.zeros(3))))
        assert not fused
        assert 'dropped' not in node._checked_health().reason
        hear(encode.odometry(ros_factory, OdometrySample(k * PERIOD_NS, np.full(3, 0.01))))
        assert not fused
        assert 'odom dropped' in node._checked_health().reason
    finally:
        node.destroy_node()
        context.try_shutdown()
