"""The selector sends the camera from view to view, and goes on while views are left."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import time
from typing import Any

import numpy as np
import pytest

from landmark_nav.messages import decode, encode
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.maps import load_map
from landmark_nav.storage.setup_files import load_robot
from landmark_nav.types import JointSample, OdometrySample

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from landmark_nav.ros.factory import message_class, ros_factory
from landmark_nav.ros.robot_client import RobotClient
from landmark_nav.ros.topics import RELIABLE

RECORDED = Path(__file__).resolve().parents[2] / 'bags'
SELECTOR = 'triplet_selector'


def test_standings_of_the_whole_map_are_reported_while_views_are_left(
    start: Callable[..., None], client: RobotClient, learned_map: Path
) -> None:
    mount, landmarks = load_robot(str(RECORDED / 'robot.yaml')), load_map(learned_map)
    drive = Bag(RECORDED / 'drive')
    info = next(drive.messages([drive.require('camera/camera_info')])).message
    camera = decode.camera_model(info)
    topics = ('camera/camera_info', 'joint_states', 'odometry/fused')
    infos, joints, fused = (client.advertise(topic) for topic in topics)
    start(SELECTOR, robot_file=str(RECORDED / 'robot.yaml'), **{'triplet.views': 'several'})
    points, atlas, *_ = encode.landmark_map(ros_factory, landmarks, 1)
    client.advertise('landmarks').publish(points)
    client.advertise('landmarks/atlas').publish(atlas)
    rankings: list[Any] = []
    landmark_visibilities: list[Any] = []
    cloud = message_class('sensor_msgs/msg/PointCloud2')
    for name, heard in (
        ('triplet_scores', rankings),
        ('landmark_visibility', landmark_visibilities),
    ):
        client._node.create_subscription(cloud, f'{SELECTOR}/{name}', heard.append, RELIABLE)

    def goes_on() -> bool:
        """Be a robot whose camera finds nothing, so that all views are left."""
        now_ns = time.time_ns()
        infos.publish(encode.camera_info(ros_factory, camera, now_ns, 'camera'))
        joints.publish(encode.joint_state(ros_factory, JointSample(now_ns, 0.0), mount))
        sample = OdometrySample(now_ns, np.array([2.0, 2.0, 0.0]), 0.0, 0.0)
        sigma = np.diag([1e-4, 1e-4, 1e-4])
        fused.publish(
            encode.odometry(ros_factory, sample, sigma, frame_id='map', child_frame_id='base')
        )
        # A ranking of one triplet alone: that whose views are left.
        return len(landmark_visibilities) >= 4 and any(ranking.width == 1 for ranking in rankings)

    # The client watches that the selector runs.
    client.wait(goes_on, 20.0, 'choices, one after the other')
    assert {visibilities.width for visibilities in landmark_visibilities} == {
        len(landmarks.landmarks)
    }
