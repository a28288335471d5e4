"""Finds landmarks in the camera's images and triangulates the robot's pose."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
import time
from typing import Any

from landmark_nav.configuration import Configuration
from landmark_nav.errors import LandmarkNavError, one_line
from landmark_nav.localization.expected_poses import ExpectedPoses
from landmark_nav.localization.late_joints import JointDelay
from landmark_nav.localization.observer import Observation, Observer, straight
from landmark_nav.messages import decode, encode
from landmark_nav.nodes.configured import calibration_of, configured
from landmark_nav.nodes.live_view import LiveView
from landmark_nav.nodes.place_search import PlaceSearch
from landmark_nav.ros.camera_frames import CameraFrames
from landmark_nav.ros.executor import LatestOnlyWorker
from landmark_nav.ros.factory import ros_factory
from landmark_nav.ros.health import Health, Level
from landmark_nav.ros.image_source import image_topics, ImageSource
from landmark_nav.ros.joining import listen_together
from landmark_nav.ros.latency import Latency
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.ros.run import run_node
from landmark_nav.types import (
    CameraFrame,
    Expectation,
    OdometrySample,
    PoseEstimate,
    Refusal,
    Triplet,
)

# Greatest number of odometry samples between two processed images: ten seconds at 50 Hz.
_BACKLOG = 500
# Greatest plausible age of an image; a greater one shows different clocks, such as that of a bag.
_OTHER_CLOCK_S = 10.0
# Least time without a new image, or since the last processed one, that is reported.
_SILENCE_S = 1.0
# Greatest time that an image waits for joint_states and odometry/fused, chosen by hand: three
# periods of an odometry at 10 Hz.
_MAX_WAIT_S = 0.3
# Greatest time from odometry/fused to an image; it is extrapolated at constant velocity.
_MAX_PRIOR_AGE_S = 0.5


class TriangulationLocalizerNode(LandmarkNode):
    """Turns images into ``detections`` and ``triangulation/pose`` by an `Observer`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('triangulation_localizer', 'detection', **options)

    def set_up(self) -> None:
        """Read parameters and files; create topics and services."""
        self._config = configured(self, 'triangulation_localizer', self._reconfigure)
        self._calibration = calibration_of(self, self._config)
        self._mount = self._calibration.mount
        self._detections = self.advertise('detections')
        self._fix = self.advertise('triangulation/pose')
        self._live = LiveView(self, self._config.map_frame)
        self._frames = CameraFrames(self, self._mount)
        self._fused = ExpectedPoses[PoseEstimate](_MAX_PRIOR_AGE_S)
        self._expected = ExpectedPoses[Expectation](_MAX_PRIOR_AGE_S)
        search = self._config.relocalization
        self._search = PlaceSearch(
            self,
            self._calibration,
            search,
            self._config.map_frame,
            self._fused.recent,
            self._config.odometry,
            self._config,
        )
        self.inputs.expect(*image_topics('camera/image_raw', self._config.image_transport))
        self._observer: Observer | None = None
        self._odometry: deque[OdometrySample] = deque(maxlen=_BACKLOG)
        self._triplet: Triplet | None = None
        self._delay_s = 0.0
        self._source: ImageSource | None = None
        # Images have their own thread, so that joint states and odometry still arrive.
        self._images = LatestOnlyWorker(self.guarded('camera/image_raw', self._on_image))
        self.close_with(self._images.close)
        self._latency = Latency()
        self._stale = 0
        self._images_unusable = False
        self._arrived_s: float | None = None
        self._looked_s: float | None = None
        self._health = Health(Level.DEGRADED, 'no landmarks: call learn_landmarks or load_map')
        self.listen('odom', self._frames.waking(self._on_odometry), depth=50)
        self.listen('odometry/fused', self._on_fused)
        self.listen('triplet', self._on_triplet)
        self.listen('expectation', self._frames.waking(self._on_expectation))
        listen_together(self, ('landmarks', 'landmarks/atlas'), self._on_landmarks)

    def _reconfigure(self, config: Configuration) -> None:
        """Use changed parameters from the next image or search on."""
        self._config, self._search.config = config, config.relocalization

    def health(self) -> Health:
        """Result of the last image, or a report that images are missing or take too long."""
        health, now_s = self._health, time.monotonic()
        level = Level.DEGRADED if health.level is Level.OK else health.level
        last = {'no image': self._arrived_s, 'no image looked at': self._looked_s}
        for what, since_s in last.items():
            if since_s is not None and now_s - since_s > _SILENCE_S:
                return Health(level, f'{what} for {now_s - since_s:.1f} s', health.values)
        return health

    def _on_odometry(self, message: Any) -> None:
        sample = decode.odometry(message)
        self._odometry.append(sample)
        self._search.add_odometry(sample)

    def _on_fused(self, message: Any) -> None:
        self._fused.add(decode.pose_estimate(message), decode.odometry(message))

    def _on_triplet(self, message: Any) -> None:
        self._triplet = decode.triplet(message)

    def _on_expectation(self, message: Any) -> None:
        expected, speeds = decode.expectation(message, self._mount)
        self._expected.add(expected, speeds)
        self._calibration = self._search.calibration = expected.calibration
        late = JointDelay(*expected.calibration['joint_delay'])
        self._delay_s = late.delay_s if late.matters else 0.0

    def _on_landmarks(self, points: Any, atlas: Any) -> None:
        config = self._config
        try:
            decode.check_frame(points.header, config.map_frame, 'set map_frame to it')
        except LandmarkNavError as error:
            self._health = Health(Level.LOST, f'landmarks dropped: {error}')
            raise
        landmarks = decode.landmark_map(points, atlas)
        self._observer = Observer(landmarks, self._calibration, config, config.estimator)
        self._search.use(landmarks)
        if self._source is None:
            self._health = Health(Level.DEGRADED, 'no image yet')
            transport = self._config.image_transport
            self._source = ImageSource(
                self, 'camera/image_raw', self._on_arrival, transport, depth=1
            )

    def _on_arrival(self, message: Any) -> None:
        self._arrived_s = time.monotonic()
        self._images.take(message)

    def _on_image(self, message: Any) -> None:
        try:
            self._use(message)
        except Exception as error:
            self._health = Health(Level.LOST, one_line(f'camera/image_raw dropped: {error}'))
            raise
        finally:
            self._looked_s = time.monotonic()

    def _use(self, message: Any) -> None:
        age_s, stamp = 1e-9 * self._age_ns(message), decode.stamp_ns(message.header)
        if self._config.max_age_s < age_s < _OTHER_CLOCK_S:
            self._stale += 1
            late = f'images arrive {age_s:.1f} s late'
            self._health = Health(Level.DEGRADED, late, {'stale': self._stale})
            return
        self._search.consider(stamp)
        searches = self._search.active and not self._images_unusable
        # An image that gave the global pose must not update it again.
        if searches and (self._look(message) or self._fused.recent(stamp) is None):
            return
        start = time.monotonic()
        seen, frame, prior = self._observe(message)
        self._images_unusable = seen.unusable
        self._search.note(stamp, len(seen.detections))
        found = replace(
            seen.detections,
            uv_px=frame.camera.in_full_image(seen.detections.uv_px),
        )
        self._detections.publish(encode.detections(ros_factory, found, self._mount.base_frame))
        self._latency.note(self._age_ns(message))
        if self._fix.get_subscription_count() and isinstance(seen.fix, PoseEstimate):
            self._fix.publish(encode.pose(ros_factory, seen.fix, self._config.map_frame))
        self._health = self._judged(seen, time.monotonic() - start)
        self._live.show(
            frame,
            prior,
            seen,
            self._search.landmarks,
            self._calibration.mount,
            self._triplet,
            message.header.frame_id,
        )

    def _look(self, message: Any) -> bool:
        """Continue global localization with an image; return whether the pose was found."""
        frame = straight(self._complete(message, self._search.reaches), self._calibration)
        outcome = self._search.look(frame)
        found = 'pose found, and published on global_localization/pose'
        words = f'looking for the place: {outcome}' if isinstance(outcome, Refusal) else found
        self._health = Health(Level.LOST, words)
        return not isinstance(outcome, Refusal)

    def _observe(self, message: Any) -> tuple[Observation, CameraFrame, PoseEstimate]:
        """Observation in an image, the frame, and the expected pose of the base."""
        stamp = decode.stamp_ns(message.header)
        assert self._observer is not None, 'images come after the map'
        frame = self._complete(message, self._expected.reaches)
        while self._odometry:
            self._observer.add_odometry(self._odometry.popleft())
        expected = self._expected.at(stamp)
        if isinstance(expected, Refusal):
            raise LandmarkNavError(str(expected))
        return self._observer.look(frame, expected), frame, expected

    def _complete(self, message: Any, also: Callable[[int], bool]) -> CameraFrame:
        """Decoded image with its calibration and joint angles."""
        return self._frames.complete(message, _MAX_WAIT_S, also, self._delay_s)

    def _age_ns(self, message: Any) -> int:
        """Time since an image was taken."""
        return int(self.get_clock().now().nanoseconds) - decode.stamp_ns(message.header)

    def _judged(self, seen: Observation, seconds: float) -> Health:
        found = set(seen.detections.ids.tolist())
        values: dict[str, object] = {
            'found': len(found),
            'not_found': len(seen.refused),
            'update_ms': f'{seconds * 1e3:.0f}',
            'overtaken': self._images.dropped,
            'stale': self._stale,
        } | self._latency.values()
        if self._triplet is not None:
            values['of_the_triplet'] = len(found & set(self._triplet.ids.tolist()))
        if seen.unusable:
            return Health(Level.DEGRADED, str(seen.fix), values)
        if not found:
            return Health(Level.DEGRADED, 'no landmark found', values)
        return Health(Level.OK, f'{len(found)} landmarks found', values)


def main() -> int:
    """Entry point of the executable."""
    return run_node(TriangulationLocalizerNode)


if __name__ == '__main__':
    raise SystemExit(main())
