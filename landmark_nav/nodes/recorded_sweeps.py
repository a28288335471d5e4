"""Sweeps received on topics: frames, angles and pose, joined."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from threading import Lock
import time
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.learning.sweep import assemble_sweep, missing_frames
from landmark_nav.messages import decode
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.types import ImageArray, JointSample, PoseEstimate, Sweep

# Greatest number of frames of a sweep, and their size; those that arrived before belong to an
# aborted sweep.
_MAX_FRAMES, _MAX_BYTES = 1440, 2**30
# Greatest time for frames that arrive after their trajectory, chosen by hand.
_LATE_FRAMES_S = 3.0


@dataclass(frozen=True, eq=False)
class RecordedSweep:
    """
    A sweep with its image messages, which are not decoded and may be compressed.

    `trajectory` has the angles of the frames; `frames` are image message and camera calibration by
    stamp; `pose_map_base` was given on ``sweep/pose``, if at all.
    """

    trajectory: tuple[JointSample, ...]
    frames: dict[int, tuple[Any, decode.CameraInfo]]
    pose_map_base: PoseEstimate | None

    @property
    def stamp_ns(self) -> int:
        """Stamp of the first frame of the trajectory."""
        return self.trajectory[0].stamp_ns

    @property
    def span_ns(self) -> tuple[int, int]:
        """Earliest and latest stamp."""
        stamps = [sample.stamp_ns for sample in self.trajectory]
        return min(stamps), max(stamps)

    @property
    def size_bytes(self) -> int:
        """Size of the images."""
        return sum(len(image.data) for image, _ in self.frames.values())

    def decoded(self, depth: decode.BitDepth, drop: Callable[[str, object], None]) -> Sweep:
        """
        Decode the images; `drop` is called with topic and reason if one cannot be used.

        Raises `LandmarkNavError`: no frame is left.
        """
        views: dict[int, tuple[ImageArray, CameraModel, int]] = {}
        for stamp, (image, info) in self.frames.items():
            try:
                pixels, camera = decode.camera_image(image, info, depth=depth)
            except LandmarkNavError as error:
                drop('sweep/image', error)
            else:
                views[stamp] = pixels, camera, depth.bits
        lowered = {
            stamp: (depth.lowered(pixels, bits), camera)
            for stamp, (pixels, camera, bits) in views.items()
        }
        return assemble_sweep(self.trajectory, lowered, self.pose_map_base)


class SweepInbox:
    """
    Joins the messages on ``sweep/*``; the frame of ``sweep/pose`` must be `frame_id`.

    `on_sweep` is called with each sweep in its own callback group, so that frames still arrive
    meanwhile.
    """

    def __init__(
        self,
        node: LandmarkNode,
        mount: PanTiltMount,
        frame_id: str,
        on_sweep: Callable[[RecordedSweep], None],
    ) -> None:
        self._mount, self._frame_id, self._on_sweep = mount, frame_id, on_sweep
        self._drop = partial(node.drop, 'sweep/trajectory')
        self._lock = Lock()
        self._images: dict[int, Any] = {}
        self._infos: dict[int, decode.CameraInfo] = {}
        self._pose: PoseEstimate | None = None
        # Each sweep may be raw or compressed.
        node.listen('sweep/image', self._on_image)
        node.listen('sweep/image/compressed', self._on_image)
        node.listen('sweep/camera_info', self._on_camera_info)
        node.listen('sweep/pose', self._on_pose)
        group = MutuallyExclusiveCallbackGroup()
        node.listen('sweep/trajectory', self._on_trajectory, group=group)

    def _on_image(self, message: Any) -> None:
        with self._lock:
            _remember(self._images, decode.stamp_ns(message.header), message)
            while sum(len(image.data) for image in self._images.values()) > _MAX_BYTES:
                del self._images[next(iter(self._images))]

    def _on_camera_info(self, message: Any) -> None:
        info = decode.camera_info(message)
        with self._lock:
            _remember(self._infos, decode.stamp_ns(message.header), info)

    def _on_pose(self, message: Any) -> None:
        decode.check_frame(message.header, self._frame_id, 'give it there')
        self._pose = decode.pose_estimate(message)

    def _on_trajectory(self, message: Any) -> None:
        trajectory = decode.sweep_trajectory(message, self._mount, self._drop)
        deadline = time.monotonic() + _LATE_FRAMES_S
        while missing_frames(trajectory, self._complete()) and time.monotonic() < deadline:
            time.sleep(0.05)
        frames = {sample.stamp_ns for sample in trajectory} & self._complete()
        with self._lock:
            found = {stamp: (self._images[stamp], self._infos[stamp]) for stamp in sorted(frames)}
            # Older messages belong to this sweep or to an aborted one.
            end_ns = max((sample.stamp_ns for sample in trajectory), default=0)
            for items in (self._images, self._infos):
                for stamp in [stamp for stamp in items if stamp <= end_ns]:
                    del items[stamp]
        pose, self._pose = self._pose, None
        self._on_sweep(RecordedSweep(tuple(trajectory), found, pose))

    def _complete(self) -> set[int]:
        """Stamps for which both image and calibration have arrived."""
        with self._lock:
            return self._images.keys() & self._infos.keys()


def _remember(items: dict[int, Any], stamp_ns: int, item: Any) -> None:
    items[stamp_ns] = item
    while len(items) > _MAX_FRAMES:
        del items[next(iter(items))]
