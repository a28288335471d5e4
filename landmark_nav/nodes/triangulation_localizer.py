"""Finds landmarks in the camera's images and triangulates the robot's pose."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from functools import partial
import time
from types import coroutine
from typing import Any

import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup

from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError, one_line
from landmark_nav.localization.expected_poses import ExpectedPoses
from landmark_nav.localization.joint_delay import JointDelay
from landmark_nav.localization.observer import Observation, Observer, straight
from landmark_nav.localization.relocalization.stream import Relocalizer, Unseen
from landmark_nav.localization.triplet.look_around import is_known
from landmark_nav.messages import decode, encode
from landmark_nav.messages.clouds import GlobalPose
from landmark_nav.nodes.configured import ConfiguredNode
from landmark_nav.nodes.live_pose import LiveView
from landmark_nav.ros.camera_frames import CameraFrames, image_topics, ImageSource
from landmark_nav.ros.health import Health, Latency, Level
from landmark_nav.ros.run import LatestOnlyWorker, run_node
from landmark_nav.ros.topics import ros_factory
from landmark_nav.types import (
    CameraFrame,
    Expectation,
    LandmarkMap,
    OdometrySample,
    PoseEstimate,
    Refusal,
    Triplet,
)

# Greatest number of odometry samples between two processed images: ten seconds at 50 Hz.
_BACKLOG = 500
# Pause of the waiting service between two checks.
_PAUSE_S = 0.005
# Greatest age of a fused pose that counts as current: the fusion may wait for the processor, and
# a search would take a second of it.
_LATE_S = 2.0
# Time after which a published global pose has become the fused pose.
_FUSED_NS = 10**9


@coroutine
def _pause() -> Generator[None, None, None]:
    """Let the executor run other callbacks for a moment."""
    time.sleep(_PAUSE_S)
    yield


@dataclass
class _Call:
    """Call of the service, shared by later calls; `outcome` is a pose once that is published."""

    until_s: float
    outcome: PoseEstimate | Refusal = field(default_factory=lambda: Refusal('no image came'))


class PlaceSearch:
    """
    Localizes globally on request or if lost, and publishes on ``global_localization/pose``.

    `fused` returns the newest fused pose, or None if its time differs from a stamp [ns] by more
    than a limit [s].
    """

    def __init__(
        self,
        node: ConfiguredNode,
        calibration: Calibration,
        fused: Callable[[int, float], PoseEstimate | None],
    ) -> None:
        # The current estimate, which is updated from outside.
        self.calibration = calibration
        self._node, self._fused = node, fused
        self._moves = False
        self.landmarks = LandmarkMap(())
        self._odometry: deque[OdometrySample] = deque(maxlen=_BACKLOG)
        self._relocalizer: Relocalizer | None = None
        self._unseen = Unseen(node.config.relocalization.unseen_s)
        self._call: _Call | None = None
        self._published_ns = -_FUSED_NS
        self._place = node.advertise('global_localization/pose')
        node.offer('relocalize', self._search, group=ReentrantCallbackGroup())

    def use(self, landmarks: LandmarkMap) -> None:
        """Search these landmarks from now on."""
        self.landmarks = landmarks
        if self.active:
            self._restart()

    @property
    def active(self) -> bool:
        """Whether a search runs, which needs images."""
        return self._relocalizer is not None

    def reaches(self, stamp_ns: int) -> bool:
        """Whether odometry of that time or later is known."""
        # Another thread may replace the queue meanwhile.
        known = self._odometry
        return bool(known) and known[-1].stamp_ns >= stamp_ns

    def consider(self, stamp_ns: int) -> None:
        """
        Start a search if the fused pose is unknown at a time, and end it if the pose is known.

        A pose at which no landmark has been detected for some time counts as unknown. Without
        odometry no search is started, as the fusion could not use its result.
        """
        wanted = (
            self._node.config.relocalization.when_lost and self._moves and self.landmarks.landmarks
        )
        on_its_way = 0 <= stamp_ns - self._published_ns < _FUSED_NS
        if not wanted or on_its_way:
            return
        fused = self._fused(stamp_ns, _LATE_S)
        # Another thread may have accepted a call meanwhile.
        if self._call is not None:
            return
        if fused is not None and is_known(fused) and not self._unseen.lasts:
            self._relocalizer = None
        elif self._relocalizer is None:
            self._restart()

    def add_odometry(self, sample: OdometrySample) -> None:
        """Keep odometry for the next image if a search runs."""
        self._moves = True
        if self.active:
            self._odometry.append(sample)

    def note(self, stamp_ns: int, found: int) -> None:
        """Note the number of landmarks detected in an image."""
        self._unseen.note(stamp_ns, found)

    def look(self, frame: CameraFrame) -> PoseEstimate | Refusal:
        """Continue the search with an image; return the pose, or why it is not known yet."""
        relocalizer = self._relocalizer
        if relocalizer is None:
            return Refusal('nobody looks for it any more')
        known = self._odometry
        while known and known[0].stamp_ns <= frame.stamp_ns:
            relocalizer.add_odometry(known.popleft())
        outcome = relocalizer.add_frame(frame)
        # The pose may have been given during this time.
        known = self._odometry
        self.consider(known[-1].stamp_ns if known else frame.stamp_ns)
        if self._relocalizer is not relocalizer:
            return outcome
        call = self._call
        if isinstance(outcome, PoseEstimate):
            self._relocalizer = self._call = None
            self._published_ns = frame.stamp_ns
            self._unseen.restart()
            found = relocalizer.in_time
            place = GlobalPose(
                found.stamp_ns,
                found.pose,
                found.covariance,
                relocalizer.landmark_ids,
                self.calibration.base.pan_sense * frame.pan_rate_rad_s,
            )
            self._place.publish(
                encode.global_pose(ros_factory, place, self._node.config.map_frame)
            )
        if call is not None:
            call.outcome = outcome
        return outcome

    def _restart(self) -> None:
        config, self._odometry = self._node.config, deque(maxlen=_BACKLOG)
        self._relocalizer = Relocalizer(
            self.landmarks, self.calibration.mount, config.relocalization, config.odometry, config
        )

    async def _search(self) -> str:
        if not self.landmarks.landmarks:
            raise LandmarkNavError('there are no landmarks: call learn_landmarks or load_map')
        search_s = self._node.config.relocalization.search_s
        call = self._call
        if call is None:
            call = self._call = _Call(time.monotonic() + search_s)
            self._restart()
        while isinstance(call.outcome, Refusal) and time.monotonic() < call.until_s:
            if self._node.ended.done():
                raise LandmarkNavError('the search ends with this node: call again once it runs')
            await _pause()
        outcome = call.outcome
        if self._call is call:
            self._relocalizer = self._call = None
        if isinstance(outcome, Refusal):
            raise LandmarkNavError(
                f'place not found within {search_s:g} s ({outcome}): call again and '
                'turn the camera or drive meanwhile, or publish initialpose'
            )
        x, y, heading = outcome.pose
        return f'found at ({x:.2f}, {y:.2f}) m, {np.degrees(heading):.1f} deg'


# Greatest plausible age of an image; a greater one shows different clocks, such as that of a bag.
_OTHER_CLOCK_S = 10.0
# Least time without a new image, or since the last processed one, that is reported.
_SILENCE_S = 1.0
# Greatest time that an image waits for joint_states and odometry/fused, chosen by hand: three
# periods of an odometry at 10 Hz.
_MAX_WAIT_S = 0.3
# Greatest time from odometry/fused to an image; it is extrapolated at constant velocity.
_MAX_PRIOR_AGE_S = 0.5


class TriangulationLocalizerNode(ConfiguredNode):
    """Turns images into ``detections`` and ``triangulation/pose`` by an `Observer`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('triangulation_localizer', 'detection', **options)

    def set_up(self) -> None:
        """Read parameters and files; create topics and services."""
        super().set_up()
        self._given = self._calibration = self._robot()
        self._mount = self._given.mount
        self._detections = self.advertise('detections')
        self._fix = self.advertise('triangulation/pose')
        self._live = LiveView(self, self.config.map_frame)
        self._frames = CameraFrames(self, self._mount)
        self._fused = ExpectedPoses[PoseEstimate](_MAX_PRIOR_AGE_S)
        self._expected = ExpectedPoses[Expectation](_MAX_PRIOR_AGE_S)
        self._search = PlaceSearch(self, self._given, self._fused.recent)
        self.inputs.expect(*image_topics('camera/image_raw', self.config.image_transport))
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
        self.listen_together(('landmarks', 'landmarks/atlas'), self._on_landmarks)

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
        config = self.config
        try:
            decode.check_frame(points.header, config.map_frame, 'set map_frame to it')
        except LandmarkNavError as error:
            self._health = Health(Level.LOST, f'landmarks dropped: {error}')
            raise
        landmarks = decode.landmark_map(points, atlas)
        # Until the fusion estimates it.
        self._calibration = landmarks.calibration_from(self._given)
        self._search.calibration = self._calibration
        self._observer = Observer(landmarks, self._calibration, config, config.estimator)
        self._search.use(landmarks)
        if self._source is None:
            self._health = Health(Level.DEGRADED, 'no image yet')
            transport = self.config.image_transport
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
        if self.config.max_age_s < age_s < _OTHER_CLOCK_S:
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
        found = replace(seen.detections, uv_px=frame.camera.in_full_image(seen.detections.uv_px))
        self._detections.publish(encode.detections(ros_factory, found, self._mount.base_frame))
        self._latency.note(self._age_ns(message))
        if self._fix.get_subscription_count() and isinstance(seen.fix, PoseEstimate):
            self._fix.publish(encode.pose(ros_factory, seen.fix, self.config.map_frame))
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
        frame = self._complete(message, self._search.reaches)
        self._calibration = self._calibration.for_camera(frame.camera.intrinsics, self._given)
        outcome = self._search.look(straight(frame, self._calibration))
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
        known = expected.calibration.for_camera(frame.camera.intrinsics, self._given)
        expected = replace(expected, calibration=known)
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


main = partial(run_node, TriangulationLocalizerNode)

if __name__ == '__main__':
    raise SystemExit(main())
