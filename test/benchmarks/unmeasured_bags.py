"""Bags of sweeps with odometry between them, as learning without a plan takes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from landmark_nav.evaluation.learning_report import truth_of_bag
from landmark_nav.geometry import se2
from landmark_nav.messages import encode
from landmark_nav.messages.factory import rosbag_factory
from landmark_nav.storage.bags import Bag, BagWriter
from landmark_nav.types import OdometrySample

STEP_NS = 50_000_000


def with_odometry(source: Path, path: Path, scale: float = 1.0) -> Path:
    """A bag of two sweeps with odometry whose ways are too long by `scale`."""
    truth = truth_of_bag(Bag(source))
    first, last = truth.poses[0], truth.poses[-1]
    moves = int(np.flatnonzero(np.hypot(*(truth.poses - first)[:, :2].T) > 0.05)[0])
    begin, end = int(truth.stamps_ns[moves - 1]), int(truth.stamps_ns[moves])
    stamps = np.arange(truth.stamps_ns[0] - STEP_NS, truth.stamps_ns[-1] + STEP_NS, STEP_NS)
    share = np.clip((stamps - begin) / (end - begin), 0.0, 1.0)
    way = se2.relative(first, last)
    poses = share[:, None] * way * [scale, scale, 1.0]
    factory = rosbag_factory()
    with BagWriter(path) as bag:
        for entry in Bag(source).messages():
            bag.write_serialized(entry.topic, entry.type_name, entry.data, entry.stamp_ns)
        for stamp, pose in zip(stamps.tolist(), poses, strict=True):
            bag.write('odom', encode.odometry(factory, OdometrySample(stamp, pose)), stamp)
    return path
