"""Transforms between the frames of the robot: map, odom, base, joints, camera."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import rot_y, rot_z, rotation_rpy
from landmark_nav.messages.encode.headers import duration, header, vector
from landmark_nav.messages.factory import MessageFactory
from landmark_nav.types import FloatArray, JointSample


class Transform(NamedTuple):
    """Pose of the frame `child` in `parent`: rotation (3, 3), translation (3,) in metres."""

    parent: str
    child: str
    rotation: FloatArray
    translation: FloatArray


def planar_transform(parent: str, child: str, pose: FloatArray) -> Transform:
    """Transform of a planar pose (3,) of `child` in `parent`."""
    return Transform(parent, child, rot_z(pose[2]), np.array([*pose[:2], 0.0]))


def joint_transforms(mount: PanTiltMount, joints: JointSample) -> Iterator[Transform]:
    """Yield the transforms that turn with the joints: base to pan link, pan link to tilt link."""
    pan_link, tilt_link = _links(mount)
    panned = rotation_rpy(mount.axis_rpy) @ rot_z(joints.pan_rad)
    yield Transform(mount.base_frame, pan_link, panned, np.array(mount.axis_xyz))
    yield Transform(pan_link, tilt_link, rot_y(-joints.tilt_rad), np.zeros(3))


def camera_transform(mount: PanTiltMount, optical_frame: str) -> Transform:
    """Transform of the camera on the tilt link, which does not move."""
    rotation_base, _ = mount.camera_pose_base(0.0)
    rotation = rotation_rpy(mount.axis_rpy).T @ rotation_base
    _, tilt_link = _links(mount)
    return Transform(tilt_link, optical_frame, rotation, np.array(mount.optical_center_offset))


def transforms(factory: MessageFactory, stamp_ns: int, of: Iterable[Transform]) -> Any:
    """Build a tf2_msgs/TFMessage, what ``/tf`` and ``/tf_static`` carry."""
    return factory(
        'tf2_msgs/msg/TFMessage', transforms=[_stamped(factory, stamp_ns, one) for one in of]
    )


def _stamped(factory: MessageFactory, stamp_ns: int, one: Transform) -> Any:
    x, y, z, w = Rotation.from_matrix(one.rotation).as_quat().tolist()
    return factory(
        'geometry_msgs/msg/TransformStamped',
        header=header(factory, stamp_ns, one.parent),
        child_frame_id=one.child,
        transform=factory(
            'geometry_msgs/msg/Transform',
            translation=vector(factory, 'Vector3', *one.translation),
            rotation=factory('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w),
        ),
    )


def _links(mount: PanTiltMount) -> tuple[str, str]:
    """Frames that turn with the joints, as URDF files call them."""
    pan, tilt = (name.removesuffix('_joint') for name in (mount.pan_joint, mount.tilt_joint))
    return f'{pan}_link', f'{tilt}_link'


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
