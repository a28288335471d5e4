"""Pan, tilt and camera calibration at the stamp of an image."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.angles import PanTrack, unwrap_joint, without_turns
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.messages.decode import JointNames
from landmark_nav.storage.bags.reader import Bag, BagMessage, decoded, MessageFilter
from landmark_nav.storage.bags.transforms import joints_of_transforms
from landmark_nav.types import JointSample, Refusal

# Greatest interval of two joint states between which the pan is interpolated.
_MAX_JOINT_GAP_NS = 500_000_000
# Greatest extrapolation at the last rate: a joint may start or stop at any time.
_SAME_TIME_NS = 2_000_000
# Relative variation of the rate of a joint that is commanded step by step, and its period. Joint
# states hide it if their interval is the period, and in part if it is over half of the period.
_UNEVEN, _UNEVEN_NS = 0.2, 100_000_000
# Time before and after an image for which the pan is given: the greatest joint delay.
_TRACK_NS = 400_000_000
# Least step back of stamps that shows that the clock was set back.
_CLOCK_STEP_NS = 500_000_000
# Least step of a moving joint, least number of such steps to judge the rate, and greatest rate.
_MOVING_RAD, _ENOUGH_STEPS, _FASTEST_RAD_S = 1e-3, 20, 10.0


class JointHistory:
    """
    Pan and tilt at any time, interpolated between measurements in any order.

    Of several samples with one stamp the last counts. Stamps and `tilts` [rad] of a tilt joint
    with its own driver replace those of the samples; the tilt is constant before the first and
    after the last.
    """

    def __init__(
        self, samples: Iterable[JointSample], tilts: Iterable[tuple[int, float]] = ()
    ) -> None:
        self._tilts = np.array(sorted(tilts)).T
        by_stamp = {sample.stamp_ns: sample for sample in samples}
        self._stamps = sorted(by_stamp)
        self._samples = [by_stamp[stamp] for stamp in self._stamps]
        pans_rad = [sample.pan_rad for sample in self._samples]
        self._pans_rad: list[float] = unwrap_joint(self._stamps, pans_rad).tolist()

    def at(self, stamp_ns: int) -> JointSample | Refusal:
        """Angles at `stamp_ns`, or the reason why they are not known."""
        if not self._samples:
            return Refusal('no joint_states')
        later = min(max(bisect_left(self._stamps, stamp_ns), 1), len(self._samples) - 1)
        first, second = self._samples[max(later - 1, 0)], self._samples[later]
        gap_ns = second.stamp_ns - first.stamp_ns
        beyond_ns = max(first.stamp_ns - stamp_ns, stamp_ns - second.stamp_ns)
        rate = self._rate(later)
        if rate is not None and beyond_ns <= _SAME_TIME_NS:
            share = (stamp_ns - first.stamp_ns) / gap_ns
            pan_rad = without_turns(first.pan_rad)
            tilt_rad = first.tilt_rad + share * (second.tilt_rad - first.tilt_rad)
            # The pan around this time, within the history.
            begin = max(bisect_right(self._stamps, stamp_ns - _TRACK_NS) - 1, 0)
            near = slice(begin, bisect_left(self._stamps, stamp_ns + _TRACK_NS) + 1)
            turns_rad = pan_rad - self._pans_rad[later - 1]
            return JointSample(
                stamp_ns,
                pan_rad + share * (self._pans_rad[later] - self._pans_rad[later - 1]),
                self._tilt_rad(stamp_ns, tilt_rad),
                rate,
                abs(share * (1.0 - share)) * gap_ns * 1e-9 * self._rate_change(later, rate),
                PanTrack(
                    1e-9 * (np.array(self._stamps[near]) - stamp_ns),
                    np.array(self._pans_rad[near]) + turns_rad,
                ),
            )
        nearest = min(first, second, key=lambda sample: abs(sample.stamp_ns - stamp_ns))
        if abs(nearest.stamp_ns - stamp_ns) <= _SAME_TIME_NS:
            tilt_rad = self._tilt_rad(stamp_ns, nearest.tilt_rad)
            return JointSample(stamp_ns, without_turns(nearest.pan_rad), tilt_rad)
        if stamp_ns > second.stamp_ns:
            return Refusal(f'joint_states are {beyond_ns * 1e-6:.0f} ms behind')
        if stamp_ns < first.stamp_ns:
            return Refusal(f'joint_states begin {beyond_ns * 1e-6:.0f} ms later')
        return Refusal(f'no joint_states for {gap_ns * 1e-9:.1f} s')

    def _tilt_rad(self, stamp_ns: int, with_pan_rad: float) -> float:
        """Tilt at a time: that reported with the pan, unless the tilt joint has its own driver."""
        return float(np.interp(stamp_ns, *self._tilts)) if len(self._tilts) else with_pan_rad

    def _rate(self, later: int) -> float | None:
        """Rate of the pan, rad/s, from the previous sample to sample `later`; None if unknown."""
        if not 0 < later < len(self._samples):
            return None
        gap_ns = self._stamps[later] - self._stamps[later - 1]
        known = 0 < gap_ns <= _MAX_JOINT_GAP_NS
        turned_rad = self._pans_rad[later] - self._pans_rad[later - 1]
        return 1e9 * turned_rad / gap_ns if known else None

    def _rate_change(self, later: int, rate: float) -> float:
        """Greatest deviation of the rate within an interval from its mean `rate`."""
        # It is the difference to the rates of the intervals before and after, as the rate changes
        # if a joint starts, stops or oscillates. If both are unknown, the joint may have stopped.
        beside = (self._rate(later - 1), self._rate(later + 1))
        changes = [abs(other - rate) for other in beside if other is not None]
        if not changes:
            return abs(rate)
        gap_ns = self._stamps[later] - self._stamps[later - 1]
        hidden = min(max(2.0 * gap_ns / _UNEVEN_NS - 1.0, 0.0), 1.0)
        return max(*changes, hidden * _UNEVEN * abs(rate))

    @classmethod
    def read(cls, bag: Bag, mount: PanTiltMount) -> JointHistory:
        """Read all angles of a bag whose clock was not set back; see `JointLog.read`."""
        logged, tilts = logged_joints(bag, mount)
        return cls((sample for _, sample in logged), (tilt for _, tilt in tilts))


class JointLog:
    """
    Pan and tilt at any time of a recording, during which the clock may be set back.

    All measurements come with their log times, and in their order; for `tilts` see `JointHistory`.
    """

    def __init__(
        self,
        logged: Iterable[tuple[int, JointSample]],
        tilts: Iterable[tuple[int, tuple[int, float]]] = (),
    ) -> None:
        parts: list[list[tuple[int, JointSample]]] = []
        for log_ns, sample in logged:
            if not parts or sample.stamp_ns < parts[-1][-1][1].stamp_ns - _CLOCK_STEP_NS:
                parts.append([])
            parts[-1].append((log_ns, sample))
        set_back_ns = [part[0][0] for part in parts[1:]]
        by_part: list[list[tuple[int, float]]] = [[] for _ in parts]
        for log_ns, tilt in tilts:
            by_part[bisect_right(set_back_ns, log_ns)].append(tilt)
        self._parts = [
            (
                JointHistory((sample for _, sample in part), own),
                np.array(sorted((sample.stamp_ns, log_ns) for log_ns, sample in part)).T,
            )
            for part, own in zip(parts, by_part, strict=True)
        ]

    def at(self, stamp_ns: int, log_ns: int) -> JointSample | Refusal:
        """Angles at a stamp, by the clock that was valid at the log time `log_ns`."""

        def away_ns(times: npt.NDArray[np.int64]) -> int:
            stamps, logged = times
            near = min(int(np.searchsorted(stamps, stamp_ns)), len(stamps) - 1)
            return abs(int(logged[near]) - log_ns)

        history, _ = min(self._parts, key=lambda part: away_ns(part[1]))
        return history.at(stamp_ns)

    @classmethod
    def read(cls, bag: Bag, mount: PanTiltMount) -> JointLog:
        """Read all angles of a bag; `LandmarkNavError` if it has none for `mount`."""
        return cls(*logged_joints(bag, mount))


# Log times and angles; log times, and stamps and tilts of a tilt joint with its own driver.
_Logged = tuple[list[tuple[int, JointSample]], list[tuple[int, tuple[int, float]]]]


def logged_joints(bag: Bag, mount: PanTiltMount) -> _Logged:
    """Angles of a bag with their log times, from joint states, or else from ``/tf``."""
    _, of_frame, frame = bag.given('joint_states').partition(':')
    found: dict[str, _Logged] = {}
    missing = ''
    for topic in () if of_frame else bag.candidates('joint_states'):
        names = JointNames(mount)
        logged = _of_topic(bag, topic, names)
        if logged[0]:
            found[topic] = logged
        missing = missing or f'{bag.path}: {topic}: {names.missing}'
    if not found and (turned := joints_of_transforms(bag, mount, frame)):
        found['/tf'] = turned, []
    if not found and missing:
        raise LandmarkNavError(missing)
    # `require` refuses several topics unless one has exactly this name, and a missing topic.
    topic = next(iter(found)) if len(found) == 1 else bag.require('joint_states')
    if wrong := too_fast(sample for _, sample in found[topic][0]):
        raise LandmarkNavError(f'{bag.path}: {topic}: {wrong}')
    return found[topic]


def _of_topic(bag: Bag, topic: str, names: JointNames) -> _Logged:
    """Angles of a topic; it is read again if a later message corrects the names of the joints."""
    message_filter = MessageFilter(bag, topic)
    logged: list[tuple[int, JointSample]] = []
    tilts: list[tuple[int, tuple[int, float]]] = []
    mount, taken = names.mount, None

    def angles(entry: BagMessage) -> JointSample | tuple[int, float] | None:
        nonlocal taken
        taken = names.add(entry.message.name) or taken
        stamp_ns, pan_rad, tilt_rad = decode.joint_angles(entry.message, mount)
        if pan_rad is not None:
            return JointSample(stamp_ns, pan_rad, tilt_rad or 0.0)
        return None if tilt_rad is None else (stamp_ns, tilt_rad)

    for entry in bag.messages([topic]):
        found = message_filter.take(angles, entry)
        if isinstance(found, JointSample):
            logged.append((entry.stamp_ns, found))
        elif found is not None:
            tilts.append((entry.stamp_ns, found))
    if names.mount != mount:
        if taken:
            bag.inform(f'{topic}: {taken}')
        return _of_topic(bag, topic, names)
    message_filter.report()
    if missing := names.tilt_missing:
        bag.warn(f'{bag.path}: {topic}: {missing}')
    return logged, tilts


def too_fast(samples: Iterable[JointSample]) -> Refusal | None:
    """Return why a pan is not plausible: its median rate, as single steps may be wraps."""
    timed = np.array([(1e-9 * sample.stamp_ns, sample.pan_rad) for sample in samples])
    if not len(timed):
        return None
    # A measurement may be published several times.
    changed = np.append(True, np.diff(timed[:, 1]) != 0.0)
    steps = np.diff(timed[changed], axis=0)
    moving = steps[(steps[:, 0] > 0.0) & (np.abs(steps[:, 1]) > _MOVING_RAD)]
    if len(moving) < _ENOUGH_STEPS:
        return None
    rate = float(np.median(np.abs(moving[:, 1]) / moving[:, 0]))
    if rate <= _FASTEST_RAD_S:
        return None
    why = 'are these degrees or ticks, or of two publishers?'
    return Refusal(f'the pan turns by {rate:.0f} rad/s', why)


class CameraInfos:
    """Camera calibrations by time; a driver may publish them before or after the image."""

    def __init__(self, stamped: Iterable[tuple[int, decode.CameraInfo]]) -> None:
        """Sort by time; at least one is required."""
        ordered = sorted(stamped, key=lambda pair: pair[0])
        self._stamps = np.array([stamp for stamp, _ in ordered], dtype=np.int64)
        self._infos = [info for _, info in ordered]

    def at(self, stamp_ns: int) -> decode.CameraInfo:
        """Calibration with the nearest stamp."""
        return self._infos[int(np.argmin(np.abs(self._stamps - stamp_ns)))]

    @classmethod
    def read(cls, bag: Bag, *names: str) -> CameraInfos:
        """Read the calibrations from the first topic of `names` that `bag` has."""
        topic = bag.require(*names)

        def stamped(entry: BagMessage) -> tuple[int, decode.CameraInfo]:
            return decode.stamp_ns(entry.message.header), decode.camera_info(entry.message)

        return cls(decoded(bag, topic, stamped))
