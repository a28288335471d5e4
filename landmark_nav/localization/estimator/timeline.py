"""
Odometry and images in the order of their stamps, independent of the order of arrival.

The states of the last seconds are kept. A late measurement, or odometry that replaces an
extrapolated motion, resets the filter to the state before it, and all later images are used again.
"""

from __future__ import annotations

from bisect import bisect_right
from copy import copy
from itertools import pairwise

from landmark_nav.localization.estimator.factors import ImagePoints
from landmark_nav.localization.estimator.filter import JointFilter
from landmark_nav.localization.estimator.state import State, Update
from landmark_nav.localization.odometry.track import Distrusted, OdometryTrack, steps_ns
from landmark_nav.types import OdometrySample, PoseEstimate, Refusal

# Motion is compounded in steps of about this.
_STEP_NS = 100_000_000
# Odometry is kept for this time: a place may be found in an image that old.
REACH_NS = 10 * 10**9


def move_to(stamp_ns: int, joint: JointFilter, track: OdometryTrack) -> None:
    """Predict a filter to a time by odometry."""
    begin = joint.state.stamp_ns
    if stamp_ns > begin:
        for since, until in pairwise(steps_ns(begin, stamp_ns, _STEP_NS)):
            joint.move(until, track.motion(since, until))
    joint.look_back(track)


class Timeline:
    """A joint `filter`, at the newest image, that takes measurements up to `window_s` late."""

    def __init__(self, joint: JointFilter, track: OdometryTrack, window_s: float = 2.0) -> None:
        self.filter, self._track, self._window_ns = joint, track, int(1e9 * window_s)
        # Images of the window and the state before each; the first state precedes all.
        self._images: list[ImagePoints] = []
        self._before = [joint.state]
        self._extrapolated = 0
        # The last prediction by present odometry: an image is first expected, then observed.
        self._moved: tuple[State, int, State] | None = None
        self._settle()

    @property
    def newest_ns(self) -> int:
        """Time of the newest image or odometry."""
        ends, newest = self._track.stamps_ns, self.filter.state.stamp_ns
        return newest if ends is None else max(newest, ends[1])

    def add_odometry(self, sample: OdometrySample) -> Refusal | None:
        """Add a sample of odometry; return what is wrong with it, if anything."""
        refusal, self._moved = self._track.add(sample), None
        if self._extrapolated and (refusal is None or isinstance(refusal, Distrusted)):
            # This sample replaces the extrapolation by which these images were predicted.
            self._again(len(self._images) - self._extrapolated)
        self._settle()
        return refusal

    def add_image(self, seen: ImagePoints) -> Update | Refusal:
        """Correct the state by an image; `Refusal` if it comes too late."""
        stamps = [image.stamp_ns for image in self._images]
        if seen.stamp_ns < self._before[0].stamp_ns:
            late_s = 1e-9 * (self.filter.state.stamp_ns - seen.stamp_ns)
            return Refusal('image came too late', f'{late_s:.2f} s')
        place = bisect_right(stamps, seen.stamp_ns)
        self._images.insert(place, seen)
        self._before.insert(place + 1, self._before[place])
        update = self._again(place)
        oldest_ns = self._images[-1].stamp_ns - self._window_ns
        if old := sum(image.stamp_ns < oldest_ns for image in self._images):
            del self._images[:old], self._before[:old]
            self._extrapolated = min(self._extrapolated, len(self._images))
            self._track.trim(self._before[0].stamp_ns - REACH_NS)
        return update

    def estimate(self, stamp_ns: int | None = None) -> PoseEstimate:
        """Pose of the base at a time from the first state of the window on; None: the newest."""
        return self.filter_at(self.newest_ns if stamp_ns is None else stamp_ns).estimate

    def filter_at(self, stamp_ns: int) -> JointFilter:
        """Return a copy of the filter, moved to a time from the first state of the window on."""
        other = copy(self.filter)
        at = bisect_right([state.stamp_ns for state in self._before], stamp_ns) - 1
        self._predict(other, self._before[max(at, 0)], stamp_ns)
        return other

    def _predict(self, joint: JointFilter, state: State, stamp_ns: int) -> None:
        """Set a filter to a state, moved to a time."""
        if self._moved is None or self._moved[:2] != (state, stamp_ns):
            joint.state = state
            move_to(stamp_ns, joint, self._track)
            self._moved = state, stamp_ns, joint.state
        joint.state = self._moved[2]

    def _again(self, first: int) -> Update:
        """Use the images from this one on again; return the update by this one."""
        updates = []
        for place in range(first, len(self._images)):
            image = self._images[place]
            self._predict(self.filter, self._before[place], image.stamp_ns)
            updates.append(self.filter.observe(image))
            self._before[place + 1] = self.filter.state
        last = (self._track.stamps_ns or (0, 0))[1]
        self._extrapolated = sum(image.stamp_ns > last for image in self._images)
        return updates[0]

    def _settle(self) -> None:
        """Predict without images, so that the recomputed time stays within the window."""
        ends = self._track.stamps_ns
        begin = 0 if ends is None else ends[1] - self._window_ns
        if self._before[-1].stamp_ns < begin - _STEP_NS:
            move_to(begin, self.filter, self._track)
            self._images, self._before, self._extrapolated = [], [self.filter.state], 0
            self._track.trim(begin - REACH_NS)
