"""Transforms of the simulated robot, on a machine with tf2_msgs, which the ROS wheels lack."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import encode
from landmark_nav.messages.factory import rosbag_factory
from landmark_nav.ros import topics
from landmark_nav.types import JointSample


class Recorder:
    """In place of a node: keeps what is published, by topic."""

    def __init__(self):
        self.sent: dict[str, list[Any]] = {}

    def create_publisher(self, _kind, topic, _qos):
        messages = self.sent[topic] = []
        return type('Publisher', (), {'publish': staticmethod(messages.append)})


@pytest.mark.parametrize('installed', [True, False])
def test_transforms_are_sent_where_their_type_is_installed(installed, monkeypatch):
    node, mount = Recorder(), PanTiltMount()
    if installed:
        monkeypatch.setattr(topics, 'find_spec', lambda _name: True)
        monkeypatch.setattr(topics, 'message_class', lambda name: name)
        monkeypatch.setattr(topics, 'ros_factory', rosbag_factory())
    elif find_spec('tf2_msgs') is not None:
        pytest.skip('tf2_msgs is installed')
    broadcaster = topics.TransformBroadcaster(node)  # type: ignore[arg-type]
    broadcaster.send_static(1, [encode.camera_transform(mount, 'optical')])
    broadcaster.send(2, encode.joint_transforms(mount, JointSample(2, 0.5)))
    broadcaster.send(3, [encode.planar_transform('odom', 'base_link', np.array([1.0, 2.0, 0.3]))])
    children = {
        topic: [one.child_frame_id for message in messages for one in message.transforms]
        for topic, messages in node.sent.items()
    }
    moving = ['pan_link', 'tilt_link', 'base_link']
    assert children == ({'/tf': moving, '/tf_static': ['optical']} if installed else {})
