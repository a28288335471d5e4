"""State of the pan-tilt unit by joint states: whether it stands still, angles and limits."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

import numpy as np

from landmark_nav.geometry import se2
from landmark_nav.geometry.angles import unwrap_joint, wrap_one_rad, wrap_rad
from landmark_nav.learning.capture.config import CaptureConfig
from landmark_nav.types import FloatArray, JointSample, OdometrySample

# Time for which samples are kept, and their smallest spacing.
_HISTORY_NS = 3_000_000_000
_APART_NS = 4_000_000
_MIN_SAMPLES = 3
# Motion by odometry that ends a sweep, m and rad: chosen by hand.
_MOVED_M, _MOVED_RAD = 0.01, 0.01
# The unit stands still if its rate is below this, rad/s, for at least this time, s. Chosen by
# hand: three joint states at 25 Hz are enough, and noise of 0.8 mrad is tolerated.
_SETTLED_RAD_S, _SETTLED_S = 0.01, 0.08


class JointTrack:
    """The recent joint samples, by time."""

    def __init__(self, config: CaptureConfig) -> None:
        self._config = config
        self._samples: deque[JointSample] = deque()

    @property
    def last(self) -> JointSample | None:
        """The newest sample."""
        return self._samples[-1] if self._samples else None

    def add(self, sample: JointSample) -> bool:
        """Add a sample; return False if it is not later than the newest by `_APART_NS`."""
        if self._samples and sample.stamp_ns < self._samples[-1].stamp_ns + _APART_NS:
            return False
        self._samples.append(sample)
        while self._samples[0].stamp_ns < sample.stamp_ns - _HISTORY_NS:
            self._samples.popleft()
        return True

    def stands_still(self, after_ns: int, since_ns: int, target_rad: float | None = None) -> bool:
        """
        Whether the unit has stood still, at `target_rad` if given, since `since_ns` at least.

        Only samples after `after_ns` count. In some interval that ends now and is not shorter than
        `_SETTLED_S` it moved less than the rate limit allows. Long intervals tolerate a coarse
        encoder that flickers by one step.
        """
        recent = [sample for sample in self._samples if sample.stamp_ns > after_ns][::-1]
        if len(recent) < _MIN_SAMPLES:
            return False
        stamps = np.array([sample.stamp_ns for sample in recent], dtype=np.int64)
        pans_rad = unwrap_joint(stamps, [sample.pan_rad for sample in recent])
        angles = np.column_stack((pans_rad, [sample.tilt_rad for sample in recent]))
        moved = np.maximum.accumulate(angles) - np.minimum.accumulate(angles)
        span_s = (stamps[0] - stamps) * 1e-9
        still = moved.max(axis=1) <= _SETTLED_RAD_S * span_s
        still &= (span_s >= _SETTLED_S) & (stamps <= since_ns)
        still[: _MIN_SAMPLES - 1] = False
        if target_rad is not None:
            off = np.maximum.accumulate(np.abs(wrap_rad(pans_rad - target_rad)))
            still &= off <= self._config.arrival_tolerance_rad
        return bool(still.any())

    def around(self, stamp_ns: int) -> tuple[float, float] | None:
        """Range of the pan between the samples around a stamp; None if one of them is missing."""
        stamps = [sample.stamp_ns for sample in self._samples]
        after = bisect_left(stamps, stamp_ns)
        if after < len(stamps) and stamps[after] == stamp_ns:
            return self._samples[after].pan_rad, self._samples[after].pan_rad
        if after in (0, len(stamps)):
            return None
        near = [self._samples[after - 1].pan_rad, self._samples[after].pan_rad]
        pans_rad = unwrap_joint(stamps[after - 1 : after + 1], near)
        return float(pans_rad.min()), float(pans_rad.max())

    def at(self, stamp_ns: int) -> JointSample | None:
        """Angles at a stamp, interpolated; None if the samples around it are too far apart."""
        stamps = np.array([sample.stamp_ns for sample in self._samples], dtype=np.int64)
        after = int(np.searchsorted(stamps, stamp_ns))
        if after == len(stamps) or (after == 0 and stamps[0] != stamp_ns):
            return None
        last = self._samples[after]
        first = self._samples[max(after - 1, 0)]
        gap_ns = last.stamp_ns - first.stamp_ns
        if gap_ns > self._config.stamp_gap_s * 1e9:
            return None
        share = (stamp_ns - first.stamp_ns) / gap_ns if gap_ns else 0.0
        pans_rad = unwrap_joint((first.stamp_ns, last.stamp_ns), (first.pan_rad, last.pan_rad))
        return JointSample(
            stamp_ns,
            first.pan_rad + share * float(pans_rad[1] - pans_rad[0]),
            first.tilt_rad + share * (last.tilt_rad - first.tilt_rad),
        )


class PanReach:
    """
    Steps that the pan joint can reach, by its configured limits and by observed stops.

    A stop before the target counts as a limit. Its pan is `unconfirmed_limit_rad` until the joint
    moves again, as it might be stuck. A joint that has not moved at all counts as stuck.
    """

    def __init__(self, config: CaptureConfig) -> None:
        self._config = config
        self._first_rad: float | None = None
        self._has_moved = False
        self.unconfirmed_limit_rad: float | None = None
        self.stops_rad: list[float] = []
        self._low, self._high = config.pan_min_rad, config.pan_max_rad

    @property
    def targets(self) -> FloatArray:
        """Pan of each step, (frames,); NaN out of reach."""
        return self._config.targets(self._low, self._high)

    def nearest(self, pan_rad: float) -> float:
        """Return the pan clipped to the limits."""
        return float(np.clip(pan_rad, self._low, self._high))

    def add(self, pan_rad: float) -> None:
        """Add a measured pan; a joint that moves is not stuck."""
        tolerance = self._config.arrival_tolerance_rad
        if self._first_rad is None:
            self._first_rad = pan_rad
        self._has_moved |= abs(wrap_one_rad(pan_rad - self._first_rad)) > tolerance
        limit_rad = self.unconfirmed_limit_rad
        if limit_rad is not None and abs(wrap_one_rad(pan_rad - limit_rad)) > tolerance:
            self.unconfirmed_limit_rad = None

    def stop(self, pan_rad: float, target_rad: float) -> bool:
        """Record a stop on the way to a target as a limit; return False if the joint is stuck."""
        if self.unconfirmed_limit_rad is not None or not self._has_moved:
            return False
        self.unconfirmed_limit_rad = pan_rad
        self.stops_rad.append(pan_rad)
        margin = self._config.arrival_tolerance_rad
        if target_rad > pan_rad:
            self._high = pan_rad + margin
        else:
            self._low = pan_rad - margin
        return True


class BaseMotion:
    """Motion of the base since the first frame, by odometry; without odometry it stands still."""

    def __init__(self) -> None:
        self._first: OdometrySample | None = None
        self._last: OdometrySample | None = None

    def add(self, sample: OdometrySample, *, anew: bool) -> None:
        """Add a pose of the base; with `anew` the motion is relative to this pose."""
        self._last = sample
        if anew or self._first is None:
            self._first = sample

    @property
    def known(self) -> bool:
        """Whether there is odometry."""
        return self._last is not None

    @property
    def moved(self) -> str:
        """Text of the motion since the first frame; '' if the base stands still."""
        if self._first is None or self._last is None:
            return ''
        way = se2.relative(self._first.pose_odom_base, self._last.pose_odom_base)
        way_m, turn_rad = float(np.hypot(way[0], way[1])), abs(float(way[2]))
        if way_m <= _MOVED_M and turn_rad <= _MOVED_RAD:
            return ''
        return f'{100.0 * way_m:.1f} cm and {np.degrees(turn_rad):.1f} deg'
