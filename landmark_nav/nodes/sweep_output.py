"""What a sweep publishes: its frames as they are taken, its angles at the end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sensor_msgs.msg import CompressedImage

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages.encode import sweep_trajectory
from landmark_nav.ros.factory import ros_factory
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.types import JointSample


class SweepOutput:
    """Publishers of ``sweep/*``."""

    def __init__(self, node: LandmarkNode, mount: PanTiltMount) -> None:
        self._mount = mount
        self._raw = node.advertise('sweep/image')
        self._compressed = node.advertise('sweep/image/compressed')
        self._info = node.advertise('sweep/camera_info')
        self._trajectory = node.advertise('sweep/trajectory')

    def frame(self, image: Any, info: Any) -> None:
        """Publish a frame in the form it came in, and its calibration with the same stamp."""
        info.header.stamp = image.header.stamp
        (self._compressed if isinstance(image, CompressedImage) else self._raw).publish(image)
        self._info.publish(info)

    def end(self, samples: Sequence[JointSample]) -> None:
        """Publish the angles of all frames, which ends the sweep."""
        self._trajectory.publish(sweep_trajectory(ros_factory, samples, self._mount))
