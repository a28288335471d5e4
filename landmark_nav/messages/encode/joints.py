"""Pan and tilt."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages.clouds import pack_cloud
from landmark_nav.messages.encode.headers import duration, header
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.messages.layouts import JOINT_DELAY
from landmark_nav.types import JointSample

__all__ = ['joint_delay', 'joint_state', 'sweep_trajectory']


def joint_state(factory: MessageFactory, sample: JointSample, mount: PanTiltMount) -> Any:
    """Build a sensor_msgs/JointState."""
    return factory(
        'sensor_msgs/msg/JointState',
        header=header(factory, sample.stamp_ns, ''),
        name=[mount.pan_joint, mount.tilt_joint],
        position=np.array([sample.pan_rad, sample.tilt_rad]),
    )


def sweep_trajectory(
    factory: MessageFactory, samples: Sequence[JointSample], mount: PanTiltMount
) -> Any:
    """Build the trajectory_msgs/JointTrajectory that ends a sweep: one point a frame."""
    start_ns = samples[0].stamp_ns
    return factory(
        'trajectory_msgs/msg/JointTrajectory',
        header=header(factory, start_ns, ''),
        joint_names=[mount.pan_joint, mount.tilt_joint],
        points=[
            factory(
                'trajectory_msgs/msg/JointTrajectoryPoint',
                positions=np.array([sample.pan_rad, sample.tilt_rad]),
                time_from_start=duration(factory, sample.stamp_ns - start_ns),
            )
            for sample in samples
        ],
    )


def joint_delay(factory: MessageFactory, stamp_ns: int, delay_s: float, sigma_s: float) -> Any:
    """Build the PointCloud2 of ``joint_delay``, one point, out of what was known at a time."""
    point = np.array([(delay_s, sigma_s)], dtype=JOINT_DELAY.fields)
    return pack_cloud(factory, header(factory, stamp_ns, ''), point)
