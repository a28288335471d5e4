"""``/tf``: pan and tilt of a bag without joint states, and transforms from other topics."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.geometry.se2 import rotation_rpy
from landmark_nav.messages import decode, encode
from landmark_nav.messages.factory import default_typestore, rosbag_factory
from landmark_nav.storage.bags.definitions import listed, TOPIC_TYPES
from landmark_nav.storage.bags.reader import Bag, BagMessage, decoded
from landmark_nav.types import FloatArray, JointSample

# Least cosine of the angle between the z axis of a frame that turns about the pan axis and the
# measured pan axis.
_UPRIGHT = math.cos(0.35)

# Child frame -> parent frame and the rotation (3, 3) between them.
_Tree = Mapping[str, tuple[str, FloatArray]]


def joints_of_transforms(
    bag: Bag, mount: PanTiltMount, frame: str = ''
) -> list[tuple[int, JointSample]]:
    """
    Return log times and angles by the transforms of a bag; none if it lacks the frame.

    The pan is the rotation of the frame of the pan joint about the pan axis of `mount`; the tilt
    is the elevation of the x axis of the frame of the tilt joint in its parent frame. If `frame`
    is empty, it is what URDF files name after ``pan_joint``: ``pan_link``, ``pan_frame`` or
    ``pan``, also with a prefix.

    Raises `LandmarkNavError`: `frame` is not in ``/tf``, or does not turn about the pan axis.
    """
    topic = bag.find('tf')
    if topic is None and not frame:
        return []
    entries = _transforms(bag, topic)
    moving = {child for _, _, child, _, _ in entries}
    pan_frame = frame.lstrip('/') if frame else _frame_of(mount.pan_joint, moving)
    if frame and pan_frame not in moving:
        raise LandmarkNavError(
            f'{bag.path}: {topic or "/tf"} has no frame {frame}: it has {listed(moving) or "none"}'
        )
    if pan_frame is None:
        bag.inform(
            f'{topic} has no frame named after {mount.pan_joint}, but {listed(moving)}: give the '
            'one that turns with it by --topic joint_states=/tf:FRAME'
        )
        return []
    tilt_frame = _frame_of(mount.tilt_joint, moving)
    fixed = _transforms(bag, bag.find('tf_static'))
    tree = {child: (parent, rotation) for _, _, child, parent, rotation in fixed}
    axis = rotation_rpy(mount.axis_rpy)
    tilt_rad = 0.0
    found = []
    for log_ns, stamp_ns, child, parent, rotation in entries:
        if child == tilt_frame and child != pan_frame:
            # The camera looks along x.
            tilt_rad = math.asin(min(max(float(rotation[2, 0]), -1.0), 1.0))
        elif child == pan_frame:
            turned = axis.T @ _to_base(parent, tree, mount.base_frame) @ rotation
            if turned[2, 2] < _UPRIGHT:
                raise LandmarkNavError(
                    f'{bag.path}: {topic}: {child} does not turn about the pan axis of robot.yaml'
                    ': give the frame that does by --topic joint_states=/tf:FRAME'
                )
            pan_rad = math.atan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1])
            if not stamp_ns:
                bag.inform(f'{topic} has stamps of 0: the time of recording is taken')
            found.append((log_ns, JointSample(stamp_ns or log_ns, pan_rad, tilt_rad)))
    bag.inform(f'the pan is taken from {topic}, as {pan_frame} turns')
    return found


def _transforms(bag: Bag, topic: str | None) -> list[tuple[int, int, str, str, FloatArray]]:
    """Log times, stamps, child frames, parent frames and rotations of the transforms."""

    def rotations(entry: BagMessage) -> list[tuple[int, int, str, str, FloatArray]]:
        found = []
        for one in entry.message.transforms:
            child, parent = (str(k).lstrip('/') for k in (one.child_frame_id, one.header.frame_id))
            rotation, stamp_ns = _rotation(one.transform.rotation), decode.stamp_ns(one.header)
            found.append((entry.stamp_ns, stamp_ns, child, parent, rotation))
        return found

    return [one for part in decoded(bag, topic, rotations) for one in part] if topic else []


def _rotation(quaternion: Any) -> FloatArray:
    x, y, z, w = (float(getattr(quaternion, name)) for name in 'xyzw')
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not 1e-3 < norm < 1e3:
        raise LandmarkNavError(f'a rotation is ({x:g}, {y:g}, {z:g}, {w:g}), not a quaternion')
    return np.asarray(Rotation.from_quat([x, y, z, w]).as_matrix())


def _frame_of(joint: str, frames: set[str]) -> str | None:
    """Frame that URDF files name after a joint; None if there is none, or no unique one."""
    stem = joint.removesuffix('_joint')
    of_joint = f'{stem}_link', f'{stem}_frame', stem
    names = (decode.matching_name(name, frames) for name in of_joint)
    return next(filter(None, names), None)


def _to_base(frame: str, tree: _Tree, base_frame: str) -> FloatArray:
    """Rotation from a frame to the base by fixed joints, as far as the tree is known."""
    rotation = np.eye(3)
    passed = set()
    while frame in tree and frame not in passed and not decode.same_frame(frame, base_frame):
        passed.add(frame)
        frame, step = tree[frame]
        rotation = step @ rotation
    return rotation


# Number of odometry samples that are kept for a fused pose of the same stamp.
_KEPT = 100


class RobotTransforms:
    """
    Derives the transforms of a robot from its odometry, joint states and camera calibration.

    The tree is map, odom, base, pan link, tilt link, camera. The transform from map to odom
    follows from ``odometry/fused``.
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
        """Topics from which transforms are derived."""
        return {'camera/camera_info', *self._of}

    def of(self, topic: str, data: bytes) -> Iterator[tuple[str, Any]]:
        """Yield topic and message of the transforms derived from a serialised message."""
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
        frame = str(message.header.frame_id)
        return [encode.planar_transform(frame, self._odom_frame, pose_map_odom)]

    def _of_joints(self, message: Any) -> list[encode.Transform]:
        stamp_ns, pan_rad, tilt_rad = decode.joint_angles(message, self._mount)
        if pan_rad is None:
            return []
        joints = JointSample(stamp_ns, pan_rad, tilt_rad or 0.0)
        return list(encode.joint_transforms(self._mount, joints))
