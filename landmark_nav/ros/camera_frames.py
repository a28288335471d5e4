"""Subscriptions to images, joint states and camera_info, frames, maps, pan commands."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from math import isfinite
from threading import Condition
from typing import Any, TypeVar

from builtin_interfaces.msg import Duration
import numpy as np
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from landmark_nav.errors import LandmarkNavError, one_line
from landmark_nav.geometry.angles import unwrap_joint
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.ros.health import steady_clock
from landmark_nav.ros.inputs import IrrelevantError
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.topics import RELIABLE
from landmark_nav.storage.bags.timelines import JointHistory, too_fast
from landmark_nav.types import CameraFrame, ImageArray, JointSample, LandmarkMap, Refusal

T = TypeVar('T')


def image_topics(topic: str, transport: str) -> list[str]:
    """Topics with the images of `topic` by a transport; both for ``auto``."""
    topics = {'raw': topic, 'compressed': f'{topic}/compressed'}
    return [topics[transport]] if transport in topics else list(topics.values())


# Time without compressed images after which raw ones are taken again.
_SILENCE_S = 3.0


class ImageSource:
    """
    Subscription to the images of `topic` or of ``topic/compressed``.

    With the transport ``auto`` both are subscribed. Raw images are used until the first compressed
    one; then the raw subscription ends, until compressed images stop to come: that saves
    bandwidth, and common middleware loses large messages. A repeated image is handled once.
    """

    def __init__(
        self,
        node: LandmarkNode,
        topic: str,
        callback: Callable[[Any], None],
        transport: str = 'auto',
        *,
        depth: int | None = None,
    ) -> None:
        self._node, self._callback, self._depth = node, callback, depth
        self._last: Any = None
        self._topics, self._raw = image_topics(topic, transport), topic
        self._compressed_came = False
        self._subscriptions: dict[str, Subscription[Any]] = {}
        self._listen()
        self._timer = node.create_timer(_SILENCE_S, self._look, clock=steady_clock())

    def close(self) -> None:
        """End the subscription."""
        self._topics = []
        self._node.destroy_timer(self._timer)
        self._keep('')

    def _listen(self) -> None:
        """Subscribe to all topics."""
        for name in self._topics:
            if name not in self._subscriptions:
                take = partial(self._take, name)
                self._subscriptions[name] = self._node.listen(name, take, depth=self._depth)

    def _look(self) -> None:
        """Take raw images again if no compressed one came since the last look."""
        if not self._compressed_came:
            self._listen()
        self._compressed_came = False

    def _take(self, name: str, message: Any) -> None:
        if name not in self._subscriptions or message == self._last:
            return
        if name != self._raw:
            self._compressed_came = True
            self._keep(name)
        self._last = message
        self._callback(message)

    def _keep(self, name: str) -> None:
        """End the subscriptions to other topics."""
        for other in list(self._subscriptions):
            # Another thread may close it at the same time.
            if other != name and (ended := self._subscriptions.pop(other, None)) is not None:
                self._node.destroy_subscription(ended)


def listen_for_map(
    node: LandmarkNode, frame_id: str, callback: Callable[[LandmarkMap], None]
) -> None:
    """Call back with each map; one in another frame is dropped."""

    def take(points: Any, atlas: Any) -> None:
        decode.check_frame(points.header, frame_id, 'set map_frame to it')
        callback(decode.landmark_map(points, atlas))

    node.listen_together(('landmarks', 'landmarks/atlas'), take)


# Time for which a tilt joint with a driver of its own may be later than the pan.
_TILT_LATE_NS = 10**9


def listen_for_joints(
    node: LandmarkNode,
    mount: PanTiltMount,
    on_sample: Callable[[JointSample], None],
    on_tilt: Callable[[int, float], None],
    *,
    depth: int | None = None,
) -> None:
    """
    Subscribe to joint states.

    `on_tilt` is called with stamp, ns, and tilt, rad, if the tilt joint has messages of its own.
    Diagnostics list the names of the joints while the pan joint is not among them.
    """
    names = decode.JointNames(mount)
    since_ns: int | None = None

    def take(message: Any) -> None:
        nonlocal since_ns
        if taken := names.add(message.name):
            node.get_logger().info(f'joint_states: {taken}')
        stamp_ns, pan_rad, tilt_rad = decode.joint_angles(message, names.mount)
        if pan_rad is not None:
            on_sample(JointSample(stamp_ns, pan_rad, tilt_rad or 0.0))
            since_ns = stamp_ns if since_ns is None else since_ns
            if abs(stamp_ns - since_ns) > _TILT_LATE_NS and (missing := names.tilt_missing):
                since_ns = stamp_ns
                node.note(f'joint_states: {missing}')
            return
        if tilt_rad is not None:
            on_tilt(stamp_ns, tilt_rad)
        raise IrrelevantError(one_line(names.missing))

    node.listen('joint_states', take, depth=depth)


# Time for which joint states are kept, and their smallest spacing; denser ones are thinned out.
_HISTORY_NS, _STEP_NS = 3 * 10**9, 5_000_000
# If a stamp is older than the newest by more than this, the clock was set back.
_CLOCK_STEP_NS = 500_000_000
# Largest delay of a separate tilt behind the pan for which frames wait.
_TILT_BEHIND_NS = 150_000_000


class CameraFrames:
    """Subscribes to ``joint_states`` and ``camera/camera_info``, and makes frames of images."""

    def __init__(self, node: LandmarkNode, mount: PanTiltMount) -> None:
        self._node = node
        self._news = Condition()
        # By stamp: the joints, and tilts of a tilt joint with its own driver.
        self._joints: deque[tuple[int, JointSample]] = deque()
        self._tilts: deque[tuple[int, float]] = deque()
        joints, tilt = self.waking(self._on_joints), self.waking(self._on_tilt)
        listen_for_joints(node, mount, joints, tilt, depth=50)
        self._info: decode.CameraInfo | None = None
        self._depth = decode.BitDepth()
        node.listen('camera/camera_info', self._on_camera_info)

    @property
    def camera(self) -> CameraModel | None:
        """Camera of the last camera_info at the resolution of the frames; None before one."""
        return None if self._info is None else self._info.camera.reduced

    @property
    def pan_rad(self) -> float | None:
        """The last measured pan; None before the first."""
        return self._joints[-1][1].pan_rad if self._joints else None

    @property
    def tilt_rad(self) -> float:
        """The last measured tilt; 0 before the first."""
        if self._tilts:
            return self._tilts[-1][1]
        return self._joints[-1][1].tilt_rad if self._joints else 0.0

    @property
    def pan_range_rad(self) -> float:
        """Range of the pan in the joint states that are kept."""
        kept = tuple(self._joints)
        pans_rad = unwrap_joint([stamp for stamp, _ in kept], [s.pan_rad for _, s in kept])
        return float(np.ptp(pans_rad)) if kept else 0.0

    def reaches(self, stamp_ns: int) -> bool:
        """Whether there are joint states with this stamp or later."""
        if not self._joints or self._joints[-1][0] < stamp_ns:
            return False
        tilt_ns = self._tilts[-1][0] if self._tilts else stamp_ns
        return tilt_ns >= stamp_ns or tilt_ns < self._joints[-1][0] - _TILT_BEHIND_NS

    def waking(self, take: Callable[..., None]) -> Callable[..., None]:
        """Wrap a callback of messages that an image may wait for: it wakes the waiting image."""

        def taken(*given: Any) -> None:
            take(*given)
            with self._news:
                self._news.notify_all()

        return taken

    def joints_at(self, stamp_ns: int) -> JointSample | Refusal:
        """Angles at a stamp, interpolated; or why they are unknown."""
        samples = tuple(sample for _, sample in tuple(self._joints))
        return too_fast(samples) or JointHistory(samples, tuple(self._tilts)).at(stamp_ns)

    def complete(
        self, message: Any, seconds: float, also: Callable[[int], bool], late_s: float
    ) -> CameraFrame:
        """
        Make a frame of an image message.

        Waits, up to `seconds`, for joint states of its stamp plus the joint delay `late_s`, and
        until `also(stamp)` is true.

        Raises `LandmarkNavError`: no camera_info of its size, or no joint states near its stamp.
        """
        stamp = decode.stamp_ns(message.header)
        joints_ns = stamp + max(0, round(1e9 * late_s))
        # Decoded first, since joint states arrive meanwhile.
        view = self._view(message)
        with self._news:
            self._news.wait_for(lambda: self.reaches(joints_ns) and also(stamp), seconds)
        joints = self.joints_at(stamp)
        if isinstance(joints, Refusal):
            why = self._node.inputs.why_none('joint_states')
            raise LandmarkNavError(f'{joints} after a wait of {seconds:g} s{why}')
        view = view or self._view(message)
        if view is None:
            why = self._node.inputs.why_none('camera/camera_info')
            raise LandmarkNavError(f'no camera_info{why}')
        return CameraFrame(
            stamp,
            *view,
            joints.pan_rad,
            joints.tilt_rad,
            pan_rate_rad_s=joints.pan_rate_rad_s,
            pan_sigma_rad=joints.pan_sigma_rad,
            pan_track=joints.pan_track,
        )

    def _on_joints(self, sample: JointSample) -> None:
        stamp_ns = sample.stamp_ns
        if len(self._joints) > 1 and 0 <= stamp_ns - self._joints[-2][0] < _STEP_NS:
            # The newest one is always kept, for `reaches`.
            if stamp_ns >= self._joints[-1][0]:
                self._joints[-1] = stamp_ns, sample
        else:
            self._joints = _remembered(self._joints, stamp_ns, sample)

    def _on_tilt(self, stamp_ns: int, tilt_rad: float) -> None:
        self._tilts = _remembered(self._tilts, stamp_ns, tilt_rad)

    def _view(self, message: Any) -> tuple[ImageArray, CameraModel] | None:
        """Pixels and camera of an image message; None before the first camera_info."""
        if self._info is None:
            return None
        return decode.camera_image(message, self._info, True, self._depth)

    def _on_camera_info(self, message: Any) -> None:
        self._info = decode.camera_info(message)


def _remembered(known: deque[tuple[int, T]], stamp_ns: int, value: T) -> deque[tuple[int, T]]:
    """Add a value; forget old ones, and all after the clock was set back."""
    if known and stamp_ns < known[-1][0] - _CLOCK_STEP_NS:
        # Replaced, not cleared: the thread of the images may read it at the same time.
        return deque([(stamp_ns, value)])
    known.append((stamp_ns, value))
    while known[0][0] < stamp_ns - _HISTORY_NS:
        known.popleft()
    return known


_TOPIC = 'pan_tilt/command'
_CLASSES: dict[str, Any] = {
    'JointTrajectory': JointTrajectory,
    'JointState': JointState,
    'Float64MultiArray': Float64MultiArray,
}
# Smallest duration of a move: controllers refuse a duration of 0.
_MIN_DURATION_S = 0.1


class PanCommander:
    """Publishes pan commands; if `with_tilt`, the tilt joint is commanded too, to 0."""

    def __init__(
        self, node: LandmarkNode, mount: PanTiltMount, kind: str, with_tilt: bool = False
    ) -> None:
        self._node, self._kind, self._rate_rad_s = node, kind, mount.pan_rate_rad_s
        self._joints = [mount.pan_joint, *([mount.tilt_joint] if with_tilt else [])]
        self._publisher = node.create_publisher(_CLASSES[kind], _TOPIC, RELIABLE)

    def command(self, pan_rad: float, from_pan_rad: float | None = None) -> None:
        """Turn to `pan_rad`; `from_pan_rad`, if known, determines the duration of the move."""
        positions = [pan_rad, 0.0][: len(self._joints)]
        if self._kind == 'Float64MultiArray':
            message: Any = Float64MultiArray(data=positions)
        elif self._kind == 'JointState':
            message = JointState(name=self._joints, position=positions)
            message.header.stamp = self._node.get_clock().now().to_msg()
        else:
            way = abs(pan_rad - from_pan_rad) if from_pan_rad is not None else 0.0
            seconds = max(way / self._rate_rad_s, _MIN_DURATION_S)
            point = JointTrajectoryPoint(
                positions=positions,
                time_from_start=Duration(sec=int(seconds), nanosec=int(seconds % 1.0 * 1e9)),
            )
            # A stamp of zero means: start on arrival.
            message = JointTrajectory(joint_names=self._joints, points=[point])
        self._publisher.publish(message)


def listen_for_pan(
    node: LandmarkNode, mount: PanTiltMount, kind: str, callback: Callable[[float], None]
) -> Subscription[Any]:
    """Call back with the pan of every command."""

    def take(message: Any) -> None:
        if kind == 'Float64MultiArray':
            names, positions = [mount.pan_joint], message.data
        elif kind == 'JointState':
            names, positions = message.name, message.position
        else:
            names = message.joint_names
            positions = message.points[-1].positions if message.points else []
        # Further positions have no name, and names without a position no value.
        pan_rad = dict(zip(names, positions, strict=False)).get(mount.pan_joint)
        if pan_rad is not None and not isfinite(pan_rad):
            raise LandmarkNavError('the pan is not a finite number')
        if pan_rad is not None:
            callback(float(pan_rad))

    return node.create_subscription(_CLASSES[kind], _TOPIC, take, RELIABLE)
