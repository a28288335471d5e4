"""``/tf`` and ``/tf_static`` out of what else is recorded, for bags of graphs without tf2."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode, encode
from landmark_nav.messages.factory import default_typestore, rosbag_factory
from landmark_nav.storage.bags.topics import TOPIC_TYPES
from landmark_nav.types import FloatArray

__all__ = ['RobotTransforms']

# Odometry that a fused pose of its stamp is looked for among.
_KEPT = 100


class RobotTransforms:
    """
    Transforms of a robot that publishes ``odom``, ``joint_states`` and ``camera/camera_info``.

    The tree is map, odom, base, pan link, tilt link, camera; map to odom follows from
    ``odometry/fused``.

    Parameters
    ----------
    mount : PanTiltMount
        Where the camera sits.

    """

    def __init__(self, mount: PanTiltMount) -> None:
        self._mount = mount
        self._store, self._factory = default_typestore(), rosbag_factory()
        self._poses_odom_base: dict[int, FloatArray] = {}
        self._odom_frame = 'odom'
        self._optical_frame = ''
        self._of: dict[str, Callable[[Any], list[encode.Transform]]] = {
            'odom': self._of_odometry,
            'odometry/fused': self._of_fused,
            'joint_states': self._of_joints,
        }

    @property
    def topics(self) -> set[str]:
        """Topics from which transforms follow."""
        return {'camera/camera_info', *self._of}

    def of(self, topic: str, data: bytes) -> Iterator[tuple[str, Any]]:
        """Topic and message of the transforms that follow from a message as serialised."""
        if topic == 'camera/camera_info':
            info: Any = self._store.deserialize_cdr(data, TOPIC_TYPES[topic])
            frame = str(info.header.frame_id)
            if frame != self._optical_frame:
                self._optical_frame = frame
                stamp_ns = decode.stamp_ns(info.header)
                camera = encode.camera_transform(self._mount, frame)
                yield 'tf_static', encode.transforms(self._factory, stamp_ns, [camera])
        elif topic in self._of:
            message: Any = self._store.deserialize_cdr(data, TOPIC_TYPES[topic])
            if found := self._of[topic](message):
                stamp_ns = decode.stamp_ns(message.header)
                yield 'tf', encode.transforms(self._factory, stamp_ns, found)

    def _of_odometry(self, message: Any) -> list[encode.Transform]:
        sample = decode.odometry(message)
        known = self._poses_odom_base
        known[sample.stamp_ns] = sample.pose_odom_base
        if len(known) > _KEPT:
            del known[next(iter(known))]
        self._odom_frame = str(message.header.frame_id)
        child = str(message.child_frame_id)
        return [encode.planar_transform(self._odom_frame, child, sample.pose_odom_base)]

    def _of_fused(self, message: Any) -> list[encode.Transform]:
        fused = decode.pose_estimate(message)
        pose_odom_base = self._poses_odom_base.get(fused.stamp_ns)
        if pose_odom_base is None:
            return []
        pose_map_odom = se2.compose(fused.pose, se2.inverse(pose_odom_base))
        return [
            encode.planar_transform(str(message.header.frame_id), self._odom_frame, pose_map_odom)
        ]

    def _of_joints(self, message: Any) -> list[encode.Transform]:
        joints = decode.joint_sample(message, self._mount)
        return [] if joints is None else list(encode.joint_transforms(self._mount, joints))
