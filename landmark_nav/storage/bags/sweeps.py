"""The sweeps in a bag: kept frames and the pan each was taken at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from landmark_nav.errors import LandmarkNavError
from landmark_nav.geometry.camera import PanTiltMount
from landmark_nav.messages import decode
from landmark_nav.storage.bags.coverage import check_coverage
from landmark_nav.storage.bags.reader import Bag, BagMessage, once
from landmark_nav.storage.bags.sieve import naming
from landmark_nav.storage.bags.timelines import CameraInfos, JointHistory
from landmark_nav.types import CameraFrame, JointSample, PoseEstimate, Sweep

__all__ = ['read_sweeps']

# Frames by stamp.
_Pictures = dict[int, BagMessage]

_SAME_FRAME_NS = 5_000_000

# Without a trajectory, a pause this many times the usual one begins another sweep.
_PAUSE = 5.0


@dataclass(frozen=True)
class _Plan:
    """Where the camera looked in one sweep, frame by frame, and what was recorded of it."""

    samples: tuple[JointSample, ...]
    pictures: tuple[BagMessage | None, ...]

    @property
    def start_ns(self) -> int:
        return self.samples[0].stamp_ns


def read_sweeps(bag: Bag, mount: PanTiltMount) -> Iterator[Sweep]:
    """
    Read the sweeps of a bag, one at a time, in the order of their start.

    The pan of a frame is the one that ``sweep/trajectory`` measured for it. That comes when a
    sweep ends: where there is none, or the bag was cut off before it, ``joint_states`` tell.

    Parameters
    ----------
    bag : Bag
        Holds ``sweep/image`` or its compressed form and ``sweep/camera_info``; may hold
        ``sweep/trajectory``, ``sweep/pose`` and ``joint_states``.
    mount : PanTiltMount
        Names of the joints.

    Yields
    ------
    Sweep
        Frames by time.

    Raises
    ------
    LandmarkNavError
        A topic is missing, a sweep has no frames at all, or a picture or angle cannot be read.
        Frames that are missing, and directions that nothing sees, go to the bag's `warn`.

    """
    topic = bag.require('sweep/image', 'sweep/image/compressed')
    cameras = CameraInfos.read(bag, 'sweep/camera_info', 'camera/camera_info')
    pictures = {decode.stamp_ns(m.message.header): m for m in bag.messages([topic])}
    plans = _plans(bag, mount, pictures)
    poses = _poses(bag, plans)
    for plan, pose in zip(plans, poses, strict=True):
        frames = []
        for sample, entry in zip(plan.samples, plan.pictures, strict=True):
            if entry is None:
                continue
            with naming(bag, topic):
                picture = decode.image(entry.message)
                camera = cameras.for_picture(sample.stamp_ns, picture.shape)
            frames.append(
                CameraFrame(sample.stamp_ns, picture, camera, sample.pan_rad, sample.tilt_rad)
            )
        missing = [s for s, e in zip(plan.samples, plan.pictures, strict=True) if e is None]
        cut_off = plan is plans[-1] and not bag.complete
        if not check_coverage(bag, plan.start_ns, frames, missing, cut_off=cut_off):
            continue
        yield Sweep(plan.start_ns, tuple(frames), pose)


def _plans(bag: Bag, mount: PanTiltMount, pictures: _Pictures) -> list[_Plan]:
    """Sweeps by trajectory, then those that only the joint states tell of, by start."""
    left = dict(pictures)
    plans = []
    if trajectory := bag.find('sweep/trajectory'):
        for entry in once(bag.messages([trajectory])):
            with naming(bag, trajectory):
                samples = decode.sweep_trajectory(entry.message, mount)
            if samples:
                ordered = tuple(sorted(samples, key=lambda sample: sample.stamp_ns))
                plans.append(_Plan(ordered, _take(ordered, left)))
    after = plans[-1].samples[-1].stamp_ns if plans else 0
    untold = sorted(stamp for stamp in left if stamp > after)
    if untold and (not plans or not bag.complete):
        bag.warn(
            f'{bag.path}: {len(untold)} frames have no sweep/trajectory: '
            'their angles are taken from joint_states'
        )
        plans.extend(_plans_by_joints(JointHistory.read(bag, mount), untold, left))
    if left:
        bag.warn(f'{bag.path}: {len(left)} frames belong to no sweep/trajectory: left out')
    if not plans:
        raise LandmarkNavError(f'{bag.path}: no frame of a sweep has a known pan')
    return sorted(plans, key=lambda plan: plan.start_ns)


def _take(samples: tuple[JointSample, ...], left: _Pictures) -> tuple[BagMessage | None, ...]:
    """Pictures of `samples`, taken out of `left`; None where there is none."""
    taken = []
    for sample in samples:
        nearest = min(left, key=lambda stamp: abs(stamp - sample.stamp_ns), default=None)
        near = nearest is not None and abs(nearest - sample.stamp_ns) <= _SAME_FRAME_NS
        taken.append(left.pop(nearest) if nearest is not None and near else None)
    return tuple(taken)


def _plans_by_joints(joints: JointHistory, stamps: list[int], left: _Pictures) -> list[_Plan]:
    """Split `stamps` into sweeps at the pauses; angles from the joint states."""
    steps = np.diff(stamps)
    usual = np.median(steps) if len(steps) else 0.0
    pauses = np.flatnonzero(steps > _PAUSE * usual) + 1
    plans = []
    for group in np.split(np.asarray(stamps, dtype=np.int64), pauses):
        told = (joints.at(int(stamp)) for stamp in group)
        samples = tuple(sample for sample in told if isinstance(sample, JointSample))
        if samples:
            plans.append(_Plan(samples, _take(samples, left)))
    return plans


def _poses(bag: Bag, plans: list[_Plan]) -> list[PoseEstimate | None]:
    """Known pose of each sweep: the last one told before its end and after the one before."""
    found: list[PoseEstimate | None] = [None] * len(plans)
    topic = bag.find('sweep/pose')
    if topic is None:
        return found
    ends = [plan.samples[-1].stamp_ns for plan in plans]
    for entry in bag.messages([topic]):
        with naming(bag, topic):
            pose = decode.pose_estimate(entry.message)
        index = int(np.searchsorted(ends, pose.stamp_ns))
        if index < len(plans):
            found[index] = pose
        elif found[-1] is None:
            found[-1] = pose
    return found
