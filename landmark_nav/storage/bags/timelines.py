"""What is needed at the stamp of a picture: pan and tilt, and the calibration."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.storage.bags.reader import Bag
from landmark_nav.types import JointSample, Refusal

__all__ = ['CameraInfos', 'JointHistory', 'naming']

# Pan between two joint states is known if they are this close.
_MAX_JOINT_GAP_NS = 500_000_000
# So far beyond them the last rate tells it: a joint may start or stop at any moment.
_SAME_TIME_NS = 2_000_000


@contextmanager
def naming(bag: Bag, topic: str) -> Iterator[None]:
    """Complaints from inside name the bag and the topic."""
    try:
        yield
    except LandmarkNavError as error:
        if str(error).startswith(str(bag.path)):
            raise
        raise LandmarkNavError(f'{bag.path}: {topic}: {error}') from error
    except AttributeError as error:
        # The bag brings its own definitions: fields may be called otherwise, or be damaged.
        raise LandmarkNavError(
            f'{bag.path}: {topic}: its definition in the bag differs from the one of ROS 2 '
            f'({error}): record it again'
        ) from error


class JointHistory:
    """
    Pan and tilt at any time, interpolated between measured ones.

    Parameters
    ----------
    samples : iterable of JointSample
        In any order.

    """

    def __init__(self, samples: Iterable[JointSample]) -> None:
        """Sort by time."""
        ordered = sorted(samples, key=lambda sample: sample.stamp_ns)
        self._stamps = [sample.stamp_ns for sample in ordered]
        self._samples = ordered

    def at(self, stamp_ns: int) -> JointSample | Refusal:
        """Angles at `stamp_ns`, or why they are not known."""
        if not self._samples:
            return Refusal('no joint_states')
        later = min(max(bisect_left(self._stamps, stamp_ns), 1), len(self._samples) - 1)
        first, second = self._samples[max(later - 1, 0)], self._samples[later]
        gap_ns = second.stamp_ns - first.stamp_ns
        beyond_ns = max(first.stamp_ns - stamp_ns, stamp_ns - second.stamp_ns)
        rate = self._rate(later)
        if rate is not None and beyond_ns <= _SAME_TIME_NS:
            share = (stamp_ns - first.stamp_ns) / gap_ns
            return JointSample(
                stamp_ns,
                first.pan_rad + share * (second.pan_rad - first.pan_rad),
                first.tilt_rad + share * (second.tilt_rad - first.tilt_rad),
                rate,
                abs(share * (1.0 - share)) * gap_ns * 1e-9 * self._rate_change(later, rate),
            )
        nearest = min(first, second, key=lambda sample: abs(sample.stamp_ns - stamp_ns))
        if abs(nearest.stamp_ns - stamp_ns) <= _SAME_TIME_NS:
            return JointSample(stamp_ns, nearest.pan_rad, nearest.tilt_rad)
        if stamp_ns > second.stamp_ns:
            return Refusal(f'joint_states are {beyond_ns * 1e-6:.0f} ms behind')
        if stamp_ns < first.stamp_ns:
            return Refusal(f'joint_states begin {beyond_ns * 1e-6:.0f} ms later')
        return Refusal(f'no joint_states for {gap_ns * 1e-9:.1f} s')

    def _rate(self, later: int) -> float | None:
        """Rate of the pan, rad/s, from one sample to a later one; None if they do not tell."""
        if not 0 < later < len(self._samples):
            return None
        first, second = self._samples[later - 1], self._samples[later]
        gap_ns = second.stamp_ns - first.stamp_ns
        known = 0 < gap_ns <= _MAX_JOINT_GAP_NS
        return 1e9 * (second.pan_rad - first.pan_rad) / gap_ns if known else None

    def _rate_change(self, later: int, rate: float) -> float:
        """
        By how much the pan may turn faster or slower in a part of an interval of that rate.

        The rates before and after it tell, on average; alone, it may have stood for a part.
        """
        beside = (self._rate(later - 1), self._rate(later + 1))
        changes = [abs(other - rate) for other in beside if other is not None]
        return sum(changes) / len(changes) if changes else abs(rate)

    @classmethod
    def read(cls, bag: Bag, mount: PanTiltMount) -> JointHistory:
        """Read all angles of a bag; `LandmarkNavError` if it has none for `mount`."""
        topic = bag.require('joint_states')
        samples = []
        for entry in bag.messages([topic]):
            with naming(bag, topic):
                sample = decode.joint_sample(entry.message, mount)
            if sample is not None:
                samples.append(sample)
        if not samples:
            raise LandmarkNavError(
                f'{bag.path}: {topic} never tells of {mount.pan_joint}: '
                'set pan_joint in robot.yaml'
            )
        return cls(samples)


class CameraInfos:
    """Calibrations by time; drivers publish them before or after the picture they belong to."""

    def __init__(self, stamped: Iterable[tuple[int, CameraModel]]) -> None:
        """Sort by time; there must be one."""
        ordered = sorted(stamped, key=lambda pair: pair[0])
        self._stamps = np.array([stamp for stamp, _ in ordered], dtype=np.int64)
        self._cameras = [camera for _, camera in ordered]

    def for_picture(self, stamp_ns: int, shape: Sequence[int]) -> CameraModel:
        """
        Calibration nearest in time to a picture of `shape` (rows, columns, ...).

        Raises
        ------
        LandmarkNavError
            It is for pictures of another size.

        """
        camera = self._cameras[int(np.argmin(np.abs(self._stamps - stamp_ns)))]
        if (camera.height, camera.width) != tuple(shape[:2]):
            raise LandmarkNavError(
                f'picture is {shape[1]} x {shape[0]}, but its camera_info is for '
                f'{camera.width} x {camera.height}: calibrate at the size that is published'
            )
        return camera

    @classmethod
    def read(cls, bag: Bag, *names: str) -> CameraInfos:
        """Read them from the first topic of `names` that `bag` has."""
        topic = bag.require(*names)
        stamped = []
        for entry in bag.messages([topic]):
            with naming(bag, topic):
                camera = decode.camera_model(entry.message)
            stamped.append((decode.stamp_ns(entry.message.header), camera))
        return cls(stamped)
