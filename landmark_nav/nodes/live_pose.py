"""What `odometry_fusion` shows people: the robot, and the lines it drew since its start."""

from __future__ import annotations

from collections.abc import Callable
import math
import time
from typing import Any

from landmark_nav.geometry import se2
from landmark_nav.messages import encode
from landmark_nav.ros.factory import ros_factory
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.types import FloatArray, OdometrySample, PoseEstimate

_PERIOD_S = 0.2
# Points of a line are at least so far apart, and no more than so many.
_STEP_M, _MOST_POINTS = 0.05, 1000
# Stamps go back by more only where the clock was set back or a bag is played anew.
_CLOCK_STEP_NS = 10**9


class ThinnedPath:
    """A nav_msgs/Path that grows, bounded: when full, every other point goes."""

    def __init__(self, frame_id: str) -> None:
        self._frame_id, self._step_m = frame_id, _STEP_M
        self._last_xy = (math.inf, math.inf)
        self._poses: list[Any] = []
        self.changed = False

    def add(self, stamp_ns: int, pose: FloatArray) -> None:
        """Go on to a pose (3,), which is kept if it is a step away from the last one."""
        x, y, _ = pose.tolist()
        if math.dist((x, y), self._last_xy) < self._step_m:
            return
        if len(self._poses) >= _MOST_POINTS:
            self._poses, self._step_m = self._poses[::2], 2.0 * self._step_m
        self._poses.append(encode.pose_stamped(ros_factory, stamp_ns, pose, self._frame_id))
        self._last_xy, self.changed = (x, y), True

    def message(self) -> Any:
        """The path up to now, stamped as its last pose."""
        self.changed = False
        return ros_factory('nav_msgs/msg/Path', header=self._poses[-1].header, poses=self._poses)


class LivePose:
    """
    Publishes paths and markers of the fused pose, five times a second, to who subscribes.

    Odometry's path begins where the fused one begins, so that both can be compared.

    Parameters
    ----------
    frame_id : str
        Frame of the fused pose.
    """

    def __init__(self, node: LandmarkNode, frame_id: str) -> None:
        self._frame_id = frame_id
        self._markers = node.advertise('odometry_fusion/markers')
        topics = ('odometry_fusion/path', 'odometry_fusion/odometry_path')
        self._outputs = [node.advertise(topic) for topic in topics]
        self._subscribers = [0 for _ in topics]
        self._published_s = -math.inf
        self.restart()

    def restart(self) -> None:
        """Begin both lines anew."""
        self._paths = [ThinnedPath(self._frame_id) for _ in self._outputs]
        self._map_from_odom: FloatArray | None = None
        self._stamp_ns = 0

    def show(
        self,
        estimate: PoseEstimate,
        odometry: OdometrySample,
        level: Callable[[], PoseEstimate | None],
    ) -> None:
        """Take the fused pose at an odometry sample; `level` gives its protection level."""
        if estimate.stamp_ns < self._stamp_ns - _CLOCK_STEP_NS:
            self.restart()
        self._stamp_ns = estimate.stamp_ns
        if self._map_from_odom is None:
            self._map_from_odom = se2.compose(estimate.pose, se2.inverse(odometry.pose_odom_base))
        alone = se2.compose(self._map_from_odom, odometry.pose_odom_base)
        for path, pose in zip(self._paths, (estimate.pose, alone), strict=True):
            path.add(estimate.stamp_ns, pose)
        now_s = time.monotonic()
        if now_s - self._published_s < _PERIOD_S:
            return
        self._published_s = now_s
        for k, (path, output) in enumerate(zip(self._paths, self._outputs, strict=True)):
            before, self._subscribers[k] = self._subscribers[k], output.get_subscription_count()
            # Who comes later sees the path also while the robot stands.
            if self._subscribers[k] > before or (self._subscribers[k] and path.changed):
                output.publish(path.message())
        if self._markers.get_subscription_count():
            drawn = encode.pose_markers(ros_factory, estimate, level(), self._frame_id)
            self._markers.publish(drawn)
