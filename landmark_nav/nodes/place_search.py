"""
Global localization: when the pose is lost, and by the service ``relocalize``.

The service is a coroutine that waits for the result of the image thread. So one thread serves all
callbacks, which needs a fraction of the time that rclpy takes with two.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
import time

import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup

from landmark_nav.calibration import Calibration
from landmark_nav.errors import LandmarkNavError
from landmark_nav.localization.late_joints import PanMotion
from landmark_nav.localization.looking import LookingConfig
from landmark_nav.localization.odometry.noise import OdometryNoiseConfig
from landmark_nav.localization.relocalization import RelocalizationConfig, Relocalizer, Unseen
from landmark_nav.localization.triplet.look_around import is_known
from landmark_nav.messages import encode
from landmark_nav.messages.layouts import GlobalPose
from landmark_nav.ros.factory import ros_factory
from landmark_nav.ros.node import LandmarkNode
from landmark_nav.types import CameraFrame, LandmarkMap, OdometrySample, PoseEstimate, Refusal

# Greatest number of odometry samples between two processed images: ten seconds at 50 Hz.
_BACKLOG = 500
# Pause of the waiting service between two checks.
_PAUSE_S = 0.005
# Greatest age of a fused pose that counts as current: the fusion may wait for the processor, and
# a search would take a second of it.
_LATE_S = 2.0
# Time after which a published global pose has become the fused pose.
_FUSED_NS = 10**9


class _Pause:
    """Short pause of a coroutine, during which the executor runs other callbacks."""

    def __await__(self) -> Generator[None, None, None]:
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
    than a limit [s]; `looking` is for the search for expected landmarks.
    """

    def __init__(
        self,
        node: LandmarkNode,
        calibration: Calibration,
        config: RelocalizationConfig,
        map_frame: str,
        fused: Callable[[int, float], PoseEstimate | None],
        odometry: OdometryNoiseConfig,
        looking: LookingConfig,
    ) -> None:
        # The current estimate, which is updated from outside.
        self.calibration = calibration
        self.config, self._map_frame = config, map_frame
        self._fused, self._noise, self._looking = fused, odometry, looking
        self._moves = False
        self.landmarks = LandmarkMap(())
        self._odometry: deque[OdometrySample] = deque(maxlen=_BACKLOG)
        self._relocalizer: Relocalizer | None = None
        self._unseen = Unseen(config.unseen_s)
        self._call: _Call | None = None
        self._published_ns = -_FUSED_NS
        self._place = node.advertise('global_localization/pose')
        self._ended = node.ended
        node.offer('relocalize', self._search, group=ReentrantCallbackGroup())

    def use(self, landmarks: LandmarkMap) -> None:
        """Search these landmarks from now on."""
        self.landmarks = landmarks
        if self.active:
            self._relocalizer = self._new_relocalizer()

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
        wanted = self.config.when_lost and self._moves and self.landmarks.landmarks
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
            self._odometry = deque(maxlen=_BACKLOG)
            self._relocalizer = self._new_relocalizer()

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
                PanMotion.of(frame, self.calibration.base).rate_rad_s,
            )
            self._place.publish(encode.global_pose(ros_factory, place, self._map_frame))
        if call is not None:
            call.outcome = outcome
        return outcome

    def _new_relocalizer(self) -> Relocalizer:
        mount = self.calibration.mount
        return Relocalizer(self.landmarks, mount, self.config, self._noise, self._looking)

    async def _search(self) -> str:
        if not self.landmarks.landmarks:
            raise LandmarkNavError('there are no landmarks: call learn_landmarks or load_map')
        call = self._call
        if call is None:
            call = self._call = _Call(time.monotonic() + self.config.search_s)
            self._odometry = deque(maxlen=_BACKLOG)
            self._relocalizer = self._new_relocalizer()
        while isinstance(call.outcome, Refusal) and time.monotonic() < call.until_s:
            if self._ended.done():
                raise LandmarkNavError('the search ends with this node: call again once it runs')
            await _Pause()
        outcome = call.outcome
        if self._call is call:
            self._relocalizer = self._call = None
        if isinstance(outcome, Refusal):
            raise LandmarkNavError(
                f'place not found within {self.config.search_s:g} s ({outcome}): call again and '
                'turn the camera or drive meanwhile, or publish initialpose'
            )
        x, y, heading = outcome.pose
        return f'found at ({x:.2f}, {y:.2f}) m, {np.degrees(heading):.1f} deg'
