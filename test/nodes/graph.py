"""Nodes of a test in one executor, in its own process; what nodes fuse beside the truth."""

import time
from typing import Any, TypeVar

from builders import bare_landmark
import numpy as np
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

from landmark_nav.evaluation.metrics import pose_errors
from landmark_nav.messages import encode
from landmark_nav.ros.topics import ros_factory
from landmark_nav.types import LandmarkMap

Made = TypeVar('Made', bound=Any)


class Graph:
    """Nodes that are added, and a way to let messages in; all are destroyed at its end."""

    def __init__(self, domain_id):
        self.context = Context()
        self.context.init(domain_id=domain_id)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.nodes: list[Any] = []

    def add(self, node):
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def make(self, kind, **parameters):
        """Make a node that is given parameters, and is not spun."""
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        self.nodes.append(kind(context=self.context, parameter_overrides=overrides))
        return self.nodes[-1]

    def until(self, condition, meanwhile=int, what=lambda: 'it did not come in time'):
        """Let messages in until a condition holds."""
        deadline = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < deadline, what()
            meanwhile()
            self.executor.spin_once(timeout_sec=0.02)

    def close(self):
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        self.context.try_shutdown()


def off(fused, truth):
    """Distance [m] and angle [rad] of a fused pose from a trajectory."""
    error = pose_errors(fused.pose[None], truth.at([fused.stamp_ns]))[0]
    return float(np.hypot(*error[:2])), float(abs(error[2]))


def is_right(client, truth):
    """Whether a pose came since the last call that claims to be well known, and is."""
    fused, client.fused = client.fused, None
    if fused is None or np.trace(fused.covariance[:2, :2]) > 0.05**2:
        return False
    away_m, turned_rad = off(fused, truth)
    return away_m < 0.05 and turned_rad < np.radians(1.0)


def map_sender(client):
    """Publishes maps as the learner does."""
    publishers = [client.advertise(topic) for topic in ('landmarks', 'landmarks/atlas')]

    def send(landmark_map, stamp_ns=1):
        messages = encode.landmark_map(ros_factory, landmark_map, stamp_ns)
        for publisher, message in zip(publishers, messages, strict=False):
            publisher.publish(message)

    return send


def small_map():
    places = [[1.0 + k, 0.0, 1.5] for k in range(4)]
    return LandmarkMap(tuple(bare_landmark(k, p, 1e-4 * np.eye(3)) for k, p in enumerate(places)))
