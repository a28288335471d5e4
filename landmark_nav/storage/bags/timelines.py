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
from landmark_nav.types import JointSample

__all__ = ['CameraInfos', 'JointHistory', 'naming']

# Pan between two joint states is known if they are this close, or one of them almost coincides.
_MAX_JOINT_GAP_NS = 500_000_000
_SAME_TIME_NS = 50_000_000


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

    def at(self, stamp_ns: int) -> JointSample | None:
        """Angles at `stamp_ns`; None if no joint state is near enough to tell."""
        after = bisect_left(self._stamps, stamp_ns)
        near = [k for k in (after - 1, after) if 0 <= k < len(self._samples)]
        if len(near) == 2 and self._stamps[near[1]] - self._stamps[near[0]] <= _MAX_JOINT_GAP_NS:
            first, second = (self._samples[k] for k in near)
            share = (stamp_ns - first.stamp_ns) / (second.stamp_ns - first.stamp_ns)
            return JointSample(
                stamp_ns,
                first.pan_rad + share * (second.pan_rad - first.pan_rad),
                first.tilt_rad + share * (second.tilt_rad - first.tilt_rad),
                1e9 * (second.pan_rad - first.pan_rad) / (second.stamp_ns - first.stamp_ns),
            )
        nearest = min(near, key=lambda k: abs(self._stamps[k] - stamp_ns), default=None)
        if nearest is None or abs(self._stamps[nearest] - stamp_ns) > _SAME_TIME_NS:
            return None
        return JointSample(
            stamp_ns, self._samples[nearest].pan_rad, self._samples[nearest].tilt_rad
        )

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
