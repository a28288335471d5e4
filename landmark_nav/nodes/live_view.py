"""Visualisation of `triangulation_localizer`: debug image, and markers of the view."""

from __future__ import annotations

import time

from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.localization.debug_image import draw_observation
from landmark_nav.localization.observer import Observation
from landmark_nav.messages import encode
from landmark_nav.ros.factory import ros_factory
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.types import CameraFrame, LandmarkMap, PoseEstimate, Triplet

_JPEG_QUALITY = 75
# Least time between two debug images, which take the detection thread 10 ms each.
_PERIOD_S = 0.2


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
