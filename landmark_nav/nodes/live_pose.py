"""Live view: markers of robot and field of view, paths since the start, debug images."""

from __future__ import annotations

from collections.abc import Callable
import math
import time
from typing import Any

from landmark_nav.geometry import se2
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.debug_image import draw_observation
from landmark_nav.localization.observer import Observation
from landmark_nav.messages import encode
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.topics import ros_factory
from landmark_nav.types import (
    CameraFrame,
    FloatArray,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Triplet,
)

# Least time between two publications; a debug image takes the detection thread 10 ms.
_PERIOD_S = 0.2
# Least initial distance of two points of a path, and greatest number of points.
_STEP_M, _MOST_POINTS = 0.05, 1000
# Least step back of stamps that shows that the clock was set back or a bag was restarted.
_CLOCK_STEP_NS = 10**9


class ThinnedPath:
    """
    Publisher of a nav_msgs/Path of bounded length to subscribers.

    When the path is full, every other point is removed.
    """

    def __init__(self, node: LandmarkNode, topic: str, frame_id: str) -> None:
        self.output, self._frame_id = node.advertise(topic), frame_id
        self._subscribers = 0
        self.restart()

    def restart(self) -> None:
        """Remove all points."""
        self._step_m, self._last_xy = _STEP_M, (math.inf, math.inf)
        self._poses: list[Any] = []
        self._changed = False

    def add(self, stamp_ns: int, pose: FloatArray) -> None:
        """Append a pose (3,) if it is at least a step away from the last one."""
        x, y, _ = pose.tolist()
        if math.dist((x, y), self._last_xy) < self._step_m:
            return
        if len(self._poses) >= _MOST_POINTS:
            self._poses, self._step_m = self._poses[::2], 2.0 * self._step_m
        self._poses.append(encode.pose_stamped(ros_factory, stamp_ns, pose, self._frame_id))
        self._last_xy, self._changed = (x, y), True

    def publish(self) -> None:
        """Publish the path if it has changed, or for a new subscriber."""
        before, self._subscribers = self._subscribers, self.output.get_subscription_count()
        if self._subscribers > before or (self._subscribers and self._changed):
            self._changed = False
            self.output.publish(self.message())

    def message(self) -> Any:
        """Return the path, with the stamp of its last pose."""
        return ros_factory('nav_msgs/msg/Path', header=self._poses[-1].header, poses=self._poses)


class LivePose:
    """
    Publishes paths and markers of the fused pose to subscribers, five times a second.

    The path of odometry starts at the first fused pose, so that both can be compared.
    """

    def __init__(self, node: LandmarkNode, frame_id: str) -> None:
        self._frame_id = frame_id
        self._markers = node.advertise('odometry_fusion/markers')
        topics = ('odometry_fusion/path', 'odometry_fusion/odometry_path')
        self._paths = [ThinnedPath(node, topic, frame_id) for topic in topics]
        self._published_s = -math.inf
        self.restart()

    def restart(self) -> None:
        """Restart both paths."""
        for path in self._paths:
            path.restart()
        self._map_from_odom: FloatArray | None = None
        self._stamp_ns = 0

    def show(
        self,
        estimate: PoseEstimate,
        odometry: OdometrySample,
        level: Callable[[], PoseEstimate | None],
    ) -> None:
        """Add the fused pose at an odometry sample; `level` returns its protection level."""
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
        for path in self._paths:
            path.publish()
        if self._markers.get_subscription_count():
            drawn = encode.pose_markers(ros_factory, estimate, level(), self._frame_id)
            self._markers.publish(drawn)


_JPEG_QUALITY = 75


class LiveView:
    """Publishes the markers of the view and at most five debug images a second, to subscribers."""

    def __init__(self, node: LandmarkNode, frame_id: str) -> None:
        self._frame_id = frame_id
        self._image = node.advertise('triangulation_localizer/debug_image/compressed')
        self._markers = node.advertise('triangulation_localizer/markers')
        self._drawn_s = -_PERIOD_S

    def show(
        self,
        frame: CameraFrame,
        pose: PoseEstimate,
        seen: Observation,
        landmarks: LandmarkMap,
        mount: PanTiltMount,
        triplet: Triplet | None,
        optical_frame: str,
    ) -> None:
        """Publish the observation in an image and the expected pose of the base."""
        now_s = time.monotonic()
        if now_s - self._drawn_s >= _PERIOD_S and self._image.get_subscription_count():
            self._drawn_s = now_s
            chosen = () if triplet is None else triplet.ids
            drawn = draw_observation(frame.image, seen, chosen)
            message = encode.compressed_image(
                ros_factory, drawn, frame.stamp_ns, optical_frame, _JPEG_QUALITY
            )
            self._image.publish(message)
        if self._markers.get_subscription_count():
            self._markers.publish(
                encode.view_markers(
                    ros_factory,
                    pose,
                    landmarks,
                    mount,
                    frame.camera,
                    frame.pan_rad,
                    seen.detections,
                    triplet,
                    self._frame_id,
                )
            )
