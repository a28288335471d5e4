"""Paths, markers and the debug image: bounded, and only for subscribers."""

from typing import Any

import cv2
import numpy as np
import pytest

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.localization.observer import Observation
from landmark_nav.nodes import live_pose
from landmark_nav.nodes.live_pose import LivePose, LiveView
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.types import (
    CameraFrame,
    Detections,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
)

PERIOD_NS = 20_000_000
IMAGE = 'triangulation_localizer/debug_image/compressed'


class Bystander(LandmarkNode):
    """Publishes what the helpers make, and may subscribe to it as well."""

    def __init__(self, **options):
        super().__init__('bystander', 'test', **options)

    def health(self):
        return Health(Level.OK, 'looking')


@pytest.fixture
def node(graph):
    return graph.add(Bystander(context=graph.context))


def estimate(k, x, y=0.0):
    return PoseEstimate(k * PERIOD_NS, np.array([x, y, 0.1]), 1e-4 * np.eye(3))


def odometry(k, x):
    return OdometrySample(k * PERIOD_NS, np.array([x, 5.0, 0.1]))


def no(*_given, **_named):
    raise AssertionError('nobody looks')


def test_without_a_subscriber_nothing_is_drawn(node, monkeypatch):
    for module, name in (
        (live_pose, 'draw_observation'),
        (live_pose.encode, 'compressed_image'),
        (live_pose.encode, 'view_markers'),
        (live_pose.encode, 'pose_markers'),
        (live_pose.ThinnedPath, 'message'),
    ):
        monkeypatch.setattr(module, name, no)
    show_image(LiveView(node, 'map'))
    live = LivePose(node, 'map')
    for k in range(3):
        live.show(estimate(k, float(k)), odometry(k, float(k)), no)


def test_the_debug_image_and_the_markers_reach_who_subscribes(graph, node):
    live, poses = LiveView(node, 'map'), LivePose(node, 'map')
    came: dict[str, list[Any]] = {
        IMAGE: [],
        'triangulation_localizer/markers': [],
        'odometry_fusion/markers': [],
    }
    for topic, messages in came.items():
        node.listen(topic, messages.append)

    def all_came():
        show_image(live)
        poses.show(estimate(1, 2.0), odometry(1, 2.0), lambda: estimate(1, 2.0))
        return all(came.values())

    graph.until(all_came)
    message = came[IMAGE][-1]
    assert message.header.frame_id == 'optical'
    image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (480, 640, 3)


def show_image(live):
    none = np.empty(0)
    nothing = Detections(0, none.astype(np.int64), none, none, none, none.reshape(0, 2))
    camera = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
    frame = CameraFrame(0, np.zeros((480, 640), np.uint8), camera, 0.1)
    seen = Observation(nothing, {}, lambda: Refusal('dark'))
    live.show(frame, estimate(0, 1.0), seen, LandmarkMap(()), PanTiltMount(), None, 'optical')
