"""
The last seconds of odometry as one continuous track, without the faults of its source.

`Jitter` estimates white noise of the poses, as of scan matchers and visual odometry, which measure
a pose each time; wheels add increments. Of four consecutive increments, the difference of the
inner two and that of the outer two have the covariance -2 v, where v is the variance of a pose.
White noise of the increments does not contribute, and a constant acceleration makes it positive.
Vibration faster than the samples has the same effect as jitter.

`Steps` finds increments of the poses that the speeds contradict, as where a source corrects its
pose or its heading by something else than wheels.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass, replace
from enum import Enum
import math

import numpy as np

from landmark_nav.geometry.se2 import compose, relative
from landmark_nav.localization.odometry.noise import (
    fraction_of_motion,
    Motion,
    motion_variances,
    OdometryNoiseConfig,
    twist_motion,
)
from landmark_nav.types import FloatArray, OdometrySample, Refusal

_IN_A_ROW = 4
# Number of samples in the running mean, and its significance, in sigmas.
_SAMPLES, _SIGNIFICANT = 200, 3.0
# Smaller jitter is covered by other noise of the odometry, m and rad.
_LEAST = (1e-3, 1e-3)


class Jitter:
    """Running estimate of the white noise of poses: m^2 on one axis, rad^2; 0 if insignificant."""

    def __init__(self) -> None:
        self.variances = (0.0, 0.0)
        self._last: deque[tuple[float, ...]] = deque(maxlen=_IN_A_ROW)
        self._count = 0
        self._mean, self._square = [0.0, 0.0], [0.0, 0.0]

    def interrupt(self) -> None:
        """Forget the last increments: the next does not follow them."""
        self._last.clear()

    def add(self, increment: FloatArray, seconds: float) -> None:
        """Add an increment (3,), forward, left [m] and turn [rad], over some time."""
        self._last.append((seconds, *(part / seconds for part in increment.tolist())))
        if len(self._last) < _IN_A_ROW:
            return
        times, *rates = zip(*self._last, strict=True)
        scale = -0.5 * (sum(times) / _IN_A_ROW) ** 2
        ahead, aside, turned = (scale * (c - b) * (d - a) for a, b, c, d in rates)
        self._count = min(self._count + 1, _SAMPLES)
        self.variances = self._counted(0, 0.5 * (ahead + aside)), self._counted(1, turned)

    def _counted(self, k: int, found: float) -> float:
        """Add a variance of position or heading; return the mean, 0 if it is insignificant."""
        self._mean[k] += (found - self._mean[k]) / self._count
        self._square[k] += (found * found - self._square[k]) / self._count
        sigma = math.sqrt(self._square[k] / self._count)
        return self._mean[k] if self._mean[k] > max(_SIGNIFICANT * sigma, _LEAST[k] ** 2) else 0.0


# Significance of a step, in sigmas; medians of chi-square with two degrees of freedom and one.
_STEP, _MEDIANS = 5.0, (1.386, 0.455)


class Steps:
    """
    Variances (m^2 on one axis, rad^2) of increments that differ from the speeds unexpectedly.

    Increment and speeds measure one motion. What changes in their difference, other than usual and
    by more than wheels, accelerations and stamps explain, is an error of one of them; its size is
    the sigma. A difference that lasts is none: speeds may be filtered, or of another scale.
    Without speeds, the increment itself must not change faster than a base accelerates.
    """

    def __init__(self) -> None:
        # Squares of the last changes of position and heading, and the times of the increments.
        self._last, self._count = np.zeros((_SAMPLES, 3)), 0
        self._rate: FloatArray | None = None
        self._late = np.zeros(2)

    def interrupt(self) -> None:
        """Forget the last difference: the next does not follow it."""
        self._rate = None

    def add(
        self, off: FloatArray, seconds: float, noise: FloatArray, speeds: FloatArray
    ) -> FloatArray:
        """Add a difference (3,), with the variances (2,) of its change and the speeds (2,)."""
        before, self._rate = self._rate, off / seconds
        change = np.zeros(3) if before is None else off - seconds * before
        squares = np.array([change[:2] @ change[:2], change[2] ** 2])
        self._last[self._count % _SAMPLES] = (*squares, seconds)
        self._count += 1
        # The median, as steps may be frequent.
        usual = np.median(self._last[: self._count], axis=0)
        late, before_late = np.square((seconds - usual[2]) * speeds), self._late
        self._late = late
        most = np.maximum(usual[:2] / _MEDIANS, noise + np.maximum(late, before_late))
        # A step changes the difference twice: there, and back.
        return np.where(squares > _STEP**2 * most, 0.5 * squares, 0.0)


# The last twist is extrapolated for this time, and the first one backwards.
HORIZON_S = 0.25
# A longer gap, such as by a clock that was set, counts as this one: a covariance without bound
# loses the digits of what is known.
_LONGEST_S = 3600.0
# Motion is compounded in at most this number of steps.
_MOST_STEPS = 3000


def steps_ns(begin_ns: int, end_ns: int, step_ns: int) -> list[int]:
    """Times from the first to the last, about `step_ns` apart, to compound motion between."""
    span_ns = min(end_ns - begin_ns, round(1e9 * _LONGEST_S))
    steps = min(max(1, round(span_ns / step_ns)), _MOST_STEPS)
    since_ns = end_ns - span_ns
    return [begin_ns, *(since_ns + span_ns * k // steps for k in range(1, steps + 1))]


# A pose is frozen if it is exactly the same in this number of samples, while their speeds add up
# to this motion (m or rad). Coarse encoders repeat a pose over less. Lower speeds than the last
# value are noise.
_FROZEN_SAMPLES, _FROZEN_WAY, _SLOW = 3, 0.03, 0.02
# A driver that restarts sets the pose to zero, to within these values and the motion of one
# interval. After this number of samples that agreed, the pose then differs from the speeds by more
# than these values and the motion itself. So it does when wheels slip, but not to zero.
_OFF_M, _OFF_RAD, _AGREED = 0.03, 0.05, 5


@dataclass(frozen=True)
class Distrusted(Refusal):
    """Why the pose of a sample is not used; its speeds are."""


class OdometryTrack:
    """
    Odometry without its jumps, which gives the motion between any two times.

    Where the pose jumps, the last twist is extrapolated and the time counts as blind; a reset to
    zero with speeds that continue does not. Samples with a frozen pose are left out. After the
    last sample, and before the first, the twist is extrapolated for `HORIZON_S`; beyond that no
    motion is assumed, and the time counts as blind. If the source gives no speeds, they are
    computed from its poses.
    """

    def __init__(self, config: OdometryNoiseConfig) -> None:
        """Start empty."""
        self._config = config
        self._stamps: list[int] = []
        self._poses: list[FloatArray] = []  # continuous
        # Sums until each: blind time [s], variances by steps of position and heading.
        self._unsure: list[FloatArray] = []
        self._first: OdometrySample | None = None
        self._last: OdometrySample | None = None
        # The last sample with a pose of its own, and the motion by the speeds since then.
        self._agreed: OdometrySample | None = None
        self._claimed, self._staying = 0.0, 0
        self._reports_speeds = False
        self._agreeing = 0
        self._jitter, self._steps = Jitter(), Steps()

    @property
    def stamps_ns(self) -> tuple[int, int] | None:
        """First and last time; None while empty."""
        return (self._stamps[0], self._stamps[-1]) if self._stamps else None

    def add(self, sample: OdometrySample) -> Refusal | None:
        """
        Append a sample.

        Returns
        -------
        Refusal or None
            Why the sample was dropped; or, if `Distrusted`, why the motion up to it was replaced
            by that of the last twist. None if it was used, or is an exact repetition.
        """
        pose = np.asarray(sample.pose_odom_base, dtype=np.float64)
        pose_odom = pose.tolist()
        self._reports_speeds |= bool(sample.linear_m_s or sample.angular_rad_s)
        if not all(map(math.isfinite, (*pose_odom, sample.linear_m_s, sample.angular_rad_s))):
            return Refusal('odometry is not a number')
        last = self._last
        if last is None:
            self._agreed = sample
            self._append(sample, pose, np.zeros(3))
            return None
        seconds = (sample.stamp_ns - last.stamp_ns) * 1e-9
        same_pose = pose_odom == np.asarray(last.pose_odom_base, dtype=np.float64).tolist()
        if seconds == 0.0 and same_pose:
            return None
        if seconds == 0.0:
            return Refusal('odometry repeated a stamp', f'{sample.stamp_ns}')
        if seconds < 0.0:
            return Refusal('odometry went back in time', f'{-seconds:.3f} s')
        increment = relative(last.pose_odom_base, sample.pose_odom_base)
        way, turn = math.hypot(increment[0], increment[1]), abs(float(increment[2]))
        # The speeds give the motion if they agreed with the poses until now.
        contradicts = self._contradicts_speeds(increment, last, sample, seconds)
        moved = sample.linear_m_s * seconds, sample.angular_rad_s * seconds
        reset = contradicts and _differs_little(pose, *moved)
        jumped = reset or way > self._config.max_speed_m_s * min(seconds, _LONGEST_S)
        jumped |= turn > self._config.max_rate_rad_s * seconds
        if jumped:
            known = min(seconds, HORIZON_S)
            increment = twist_motion(last.linear_m_s, last.angular_rad_s, known)
        if not self._reports_speeds:
            forward, _, turned = (increment / seconds).tolist()
            sample = replace(sample, linear_m_s=forward, angular_rad_s=turned)
        blind = (jumped and not reset) or seconds > self._config.max_gap_s
        if blind or jumped or same_pose:
            self._jitter.interrupt()
        else:
            self._jitter.add(increment, seconds)
        unsure = np.array([seconds if blind else 0.0, 0.0, 0.0])
        if blind or jumped:
            self._steps.interrupt()
        elif not same_pose:
            unsure[1:] = self._stepped(increment, last, sample)
        if not same_pose:
            self._agreed, self._claimed, self._staying = sample, 0.0, 0
        elif self._freezes(sample, seconds):
            return Refusal('odometry has frozen', 'its pose stays while its speeds say it moves')
        pose = self._poses[-1] if same_pose else compose(self._poses[-1], increment)
        self._append(sample, pose, unsure)
        if jumped:
            what = f'{way:.4g} m and {turn:.2f} rad in {seconds:.3f} s'
            return Distrusted('odometry jumped', what)
        return None

    def _stepped(
        self, increment: FloatArray, last: OdometrySample, sample: OdometrySample
    ) -> FloatArray:
        """Variances (2,) by a step of the pose since it last changed, as encoders are coarse."""
        agreed, config = self._agreed, self._config
        assert agreed is not None, 'one came before'
        seconds = (sample.stamp_ns - agreed.stamp_ns) * 1e-9
        if seconds > HORIZON_S:
            self._steps.interrupt()
            return np.zeros(2)
        off, fastest = increment, np.array([config.max_speed_m_s, config.max_rate_rad_s])
        if self._reports_speeds:
            speeds = [(each.linear_m_s, each.angular_rad_s) for each in (agreed, last, sample)]
            bounded = np.clip(speeds, -fastest, fastest).tolist()
            ends = [twist_motion(ahead, turn, seconds) for ahead, turn in bounded]
            off = increment - increment.clip(np.min(ends, axis=0), np.max(ends, axis=0))
        noise = motion_variances(Motion(increment, seconds, ahead_s4=4.0 * seconds**4), config)
        rates = np.array([math.hypot(increment[0], increment[1]), increment[2]]) / seconds
        return self._steps.add(off, seconds, noise[[0, 2]], rates)

    def _contradicts_speeds(
        self, increment: FloatArray, last: OdometrySample, sample: OdometrySample, seconds: float
    ) -> bool:
        """Whether the pose disagrees with the speeds for the first time after agreeing."""
        if not self._reports_speeds or seconds > HORIZON_S:
            return False
        linear = 0.5 * (last.linear_m_s + sample.linear_m_s)
        angular = 0.5 * (last.angular_rad_s + sample.angular_rad_s)
        off = increment - twist_motion(linear, angular, seconds)
        agrees = _differs_little(off, linear * seconds, angular * seconds)
        agreed, self._agreeing = self._agreeing, self._agreeing + 1 if agrees else 0
        return agreed >= _AGREED and not agrees

    @property
    def _frozen(self) -> bool:
        return self._staying >= _FROZEN_SAMPLES and self._claimed > _FROZEN_WAY

    def _freezes(self, sample: OdometrySample, seconds: float) -> bool:
        """Whether the pose is frozen; if so, remove the samples since it froze."""
        speed = max(abs(sample.linear_m_s), abs(sample.angular_rad_s))
        if speed < _SLOW and not self._frozen:
            self._agreed, self._claimed, self._staying = sample, 0.0, 0
            return False
        self._claimed += speed * seconds
        self._staying += 1
        if not self._frozen:
            return False
        agreed, pose = self._agreed, self._poses[-1]
        assert agreed is not None, 'one came before'
        while len(self._stamps) > 1 and self._stamps[-1] > agreed.stamp_ns:
            del self._stamps[-1], self._poses[-1], self._unsure[-1]
        if self._stamps[-1] < agreed.stamp_ns:
            self._append(agreed, pose, np.zeros(3))
        self._last = agreed
        return True

    def motion(self, from_ns: int, to_ns: int) -> Motion:
        """Motion between two times."""
        seconds = min((to_ns - from_ns) * 1e-9, _LONGEST_S)
        if not self._stamps:
            return Motion(np.zeros(3), seconds, seconds)
        increment = relative(self._pose(from_ns), self._pose(to_ns))
        end, begin = self._beyond_s(to_ns), self._beyond_s(from_ns)
        ahead = math.copysign(end**4, end) - math.copysign(begin**4, begin)
        blind, *steps = (self._unsure_until(to_ns) - self._unsure_until(from_ns)).tolist()
        jitter = (2.0 * variance for variance in self._jitter.variances)
        return Motion(increment, seconds, min(blind, _LONGEST_S), ahead, *jitter, *steps)

    def motion_back(self, stamp_ns: int, seconds: float) -> FloatArray:
        """Pose (3,) of the base some time before a time, in the base at that time."""
        if not self._stamps:
            return np.zeros(3)
        earlier_ns = stamp_ns - round(1e9 * seconds)
        return relative(self._pose(stamp_ns), self._pose(earlier_ns))

    def trim(self, before_ns: int) -> None:
        """Drop samples that are not needed for motions that start at `before_ns` or later."""
        keep = bisect_right(self._stamps, before_ns) - 1
        if keep > 0:
            for values in (self._stamps, self._poses, self._unsure):
                del values[:keep]

    def _append(self, sample: OdometrySample, pose: FloatArray, unsure: FloatArray) -> None:
        """Append a pose, and how unsure the motion up to it is."""
        self._first, self._last = self._first or sample, sample
        if self._stamps:
            before = self._unsure[-1]
            unsure = before + unsure if unsure.any() else before
            # Of the samples while the robot stands, only the first and the last are kept.
            stands = len(self._poses) > 1 and self._poses[-2] is self._poses[-1] is pose
            if stands and self._unsure[-2] is unsure:
                self._stamps[-1] = sample.stamp_ns
                return
        self._stamps.append(sample.stamp_ns)
        self._poses.append(pose)
        self._unsure.append(unsure)

    def _beyond_s(self, stamp_ns: int) -> float:
        """Seconds of extrapolation: after the last sample, or, negative, before the first."""
        inside = min(max(stamp_ns, self._stamps[0]), self._stamps[-1])
        return min(max((stamp_ns - inside) * 1e-9, -HORIZON_S), HORIZON_S)

    def _pose(self, stamp_ns: int) -> FloatArray:
        """Pose (3,) at a time: interpolated at constant twist, or extrapolated."""
        beyond = self._beyond_s(stamp_ns)
        if beyond:
            ends = (self._last, self._poses[-1]), (self._first, self._poses[0])
            near, pose = ends[0] if beyond > 0.0 else ends[1]
            assert near is not None
            return compose(pose, twist_motion(near.linear_m_s, near.angular_rad_s, beyond))
        after = bisect_left(self._stamps, stamp_ns)
        if self._stamps[after] == stamp_ns:
            return self._poses[after]
        begin, end = self._stamps[after - 1], self._stamps[after]
        whole = relative(self._poses[after - 1], self._poses[after])
        part = fraction_of_motion(whole, (stamp_ns - begin) / (end - begin))
        return compose(self._poses[after - 1], part)

    def _unsure_until(self, stamp_ns: int) -> FloatArray:
        """Sums of `_unsure` until then, from the earliest time that extrapolation reaches."""
        reach = int(HORIZON_S * 1e9)
        first, last = self._stamps[0] - reach, self._stamps[-1] + reach
        outside = 1e-9 * (min(stamp_ns - first, 0) + max(stamp_ns - last, 0))
        after = bisect_left(self._stamps, stamp_ns)
        before, until = (
            self._unsure[max(after - 1, 0)],
            self._unsure[min(after, len(self._unsure) - 1)],
        )
        part = 0.0
        if 0 < after < len(self._stamps):
            begin, end = self._stamps[after - 1], self._stamps[after]
            part = (stamp_ns - begin) / (end - begin)
        sums: FloatArray = before + part * (until - before) + np.array([outside, 0.0, 0.0])
        return sums


def _differs_little(off: FloatArray, way_m: float, turn_rad: float) -> bool:
    """Whether a difference of poses (3,) is within the motion of one interval."""
    near = math.hypot(off[0], off[1]) <= _OFF_M + abs(way_m)
    return near and bool(abs(off[2]) <= _OFF_RAD + abs(turn_rad))


# A stamp that is off by more than this may be wrong, or the clock was set.
_STEP_NS = 10**9
# This number of consecutive late samples, in the order of their stamps, means the same.
_LATE_IN_A_ROW = 5


class ClockStep(Enum):
    """State of the clock by a stamp."""

    NONE = 'goes on'
    OFF = 'is off'
    BACK = 'was set back'


class ClockWatch:
    """Detects steps of the clock from stamps in the order of arrival."""

    def __init__(self) -> None:
        self._late_ns = self._late_in_a_row = 0
        self._off_ns: int | None = None

    def judge(self, stamp_ns: int, odometry_ns: int, window_ns: int) -> ClockStep:
        """
        Return the state of the clock by the stamp of a sample.

        `odometry_ns` is the newest stamp of odometry. A sample that is older by less than
        `window_ns` may just be late. One that is further off has to be left out; if the next one
        follows it, the clock was set back, or there was a pause.
        """
        late = stamp_ns <= odometry_ns
        in_order = late and stamp_ns > self._late_ns
        self._late_in_a_row = self._late_in_a_row + 1 if in_order else 0
        self._late_ns = stamp_ns if late else 0
        far_back = stamp_ns < odometry_ns - max(window_ns, _STEP_NS)
        before, self._off_ns = self._off_ns, None
        if self._late_in_a_row < _LATE_IN_A_ROW:
            if not far_back and stamp_ns - odometry_ns <= _STEP_NS:
                return ClockStep.NONE
            if before is None or not 0 < stamp_ns - before <= abs(before - odometry_ns):
                self._off_ns = stamp_ns
                return ClockStep.OFF
            if not far_back:
                return ClockStep.NONE
        self._late_in_a_row = 0
        return ClockStep.BACK
