"""Pan and tilt."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages.encode.headers import duration, header
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.types import JointSample

__all__ = ['joint_state', 'sweep_trajectory']


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
